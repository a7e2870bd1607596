-- What a user does to the job ARGV[2]: ARGV[3] is pause, resume, cancel, remove or priority
-- (to ARGV[4]). Returns the job's state afterwards, or nil where there is no such job.
local job, verb = ARGV[2], ARGV[3]
local key = job_of(job)
local state, old, gen = unpack(redis.call('HMGET', key, 'state', 'priority', 'gen'))
if not state then return nil end
local open = state == 'running' or state == 'paused'

local function drop_frames()
  for _, frame in ipairs(redis.call('ZRANGE', key .. ':active', 0, -1)) do forget_frame(job, frame) end
  redis.call('DEL', key .. ':active', key .. ':held')
end

if verb == 'pause' and state == 'running' then
  redis.call('HSET', key, 'state', 'paused') -- claims put its tasks aside as they meet them
elseif verb == 'resume' and state == 'paused' then
  redis.call('HSET', key, 'state', 'running')
  for _, held in ipairs(redis.call('LRANGE', key .. ':held', 0, -1)) do
    local task = cjson.decode(held)
    send(job, task[1], task[2], task[3])
  end
  redis.call('DEL', key .. ':held')
  advance(job)
elseif verb == 'cancel' and open then
  redis.call('HSET', key, 'state', 'cancelled', 'finished', now())
  drop_frames() -- claims drop its tasks as they meet them; workers look at the state
elseif verb == 'remove' then
  drop_frames()
  redis.call('DEL', key, key .. ':done', key .. ':failed')
  redis.call('ZREM', 'pileus:jobs', job)
  return 'removed'
elseif verb == 'priority' and ARGV[4] ~= old then
  -- Tasks that wait in the old stream are copied under a new generation; claims drop the old ones.
  -- Deleting them here, undelivered, would spoil the stream's `lag`.
  redis.call('HSET', key, 'priority', ARGV[4], 'gen', redis.call('INCR', 'pileus:gen'))
  local stream = stream_of(old)
  if open and redis.call('EXISTS', stream) == 1 then
    local group = redis.call('XINFO', 'GROUPS', stream)[1]
    local after
    for i = 1, #group, 2 do if group[i] == 'last-delivered-id' then after = group[i + 1] end end
    for _, entry in ipairs(redis.call('XRANGE', stream, '(' .. after, '+')) do
      local task = {}
      for i = 1, #entry[2], 2 do task[entry[2][i]] = entry[2][i + 1] end
      if task.job == job and task.gen == gen then send(job, task.frame, task.kind, task.part) end
    end
  end
end
return redis.call('HGET', key, 'state')
