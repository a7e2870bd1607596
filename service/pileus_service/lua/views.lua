-- The jobs ARGV[2], ARGV[3], ... as they stand, in one reply of JSON: the time, and of each job its
-- fields, how many frames have failed, the first of them and why, how many wait for their caches, what
-- workers have in hand, and the frames under way, each with its fields; false for a job that is not
-- here. Hundreds of small replies would cost their reader far more than they cost Redis.
local jobs = {}
for number = 2, #ARGV do
  local key = job_of(ARGV[number])
  local held = paired(redis.call('HGETALL', key))
  local active = {}
  for _, frame in ipairs(redis.call('ZRANGE', key .. ':active', 0, -1)) do
    active[#active + 1] = { frame, paired(redis.call('HGETALL', frame_of(ARGV[number], frame))) }
  end
  jobs[number - 1] = held.state and {
    held = held,
    failed = redis.call('HLEN', key .. ':failed'),
    reason = held.first_failed and redis.call('HGET', key .. ':failed', held.first_failed) or nil,
    waiting = redis.call('HLEN', key .. ':waiting'),
    flight = paired(redis.call('HGETALL', key .. ':flight')),
    active = active,
  } or false
end
return cjson.encode({ now(), jobs })
