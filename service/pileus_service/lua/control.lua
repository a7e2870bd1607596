-- What a user does to the job ARGV[2]: ARGV[3] is pause, resume, cancel, remove, priority (to
-- ARGV[4]) or retry (as its life ARGV[4]). Returns its state afterwards, nil where there is no such job.
local job, verb = ARGV[2], ARGV[3]
local key = job_of(job)
local state, old, gen = unpack(redis.call('HMGET', key, 'state', 'priority', 'gen'))
if not state then return nil end
local open = state == 'running' or state == 'paused'

local function drop_frames()
  for _, frame in ipairs(redis.call('ZRANGE', key .. ':active', 0, -1)) do forget_frame(job, frame) end
  for _, frame in ipairs(redis.call('HKEYS', key .. ':waiting')) do
    redis.call('ZREM', 'pileus:due', job .. ' ' .. frame)
  end
  redis.call('DEL', key .. ':active', key .. ':ready', key .. ':held', key .. ':waiting', key .. ':flight')
  unlist(job, old)
end

if verb == 'pause' and state == 'running' then
  redis.call('HSET', key, 'paused', now())
  set_state(job, 'paused') -- claims put its tasks aside as they meet them
elseif verb == 'resume' and state == 'paused' then
  local started, paused = unpack(redis.call('HMGET', key, 'started', 'paused'))
  if started and paused then redis.call('HINCRBY', key, 'idle', now() - paused) end
  set_state(job, 'running')
  for _, held in ipairs(redis.call('LRANGE', key .. ':held', 0, -1)) do
    local task = cjson.decode(held)
    send(job, task[1], task[2], task[3])
  end
  redis.call('DEL', key .. ':held')
  advance(job)
elseif verb == 'cancel' and open then
  redis.call('HSET', key, 'finished', now())
  set_state(job, 'cancelled')
  drop_frames() -- claims drop its tasks as they meet them; workers find them unwanted
elseif verb == 'remove' then
  drop_frames()
  redis.call('DEL', key, key .. ':done', key .. ':failed')
  redis.call('ZREM', 'pileus:jobs', job)
  redis.call('HDEL', 'pileus:standing', job)
  redis.call('ZREM', 'pileus:changed', job)
  redis.call('INCR', 'pileus:changes')
  return 'removed'
elseif verb == 'retry' and (open or state == 'failed') then
  local failed = redis.call('HKEYS', key .. ':failed')
  redis.call('HSET', key, 'life', ARGV[4])
  redis.call('DEL', key .. ':failed')
  local first = tonumber(redis.call('HGET', key, 'next'))
  for _, frame in ipairs(failed) do first = math.min(first, tonumber(frame)) end
  redis.call('HSET', key, 'next', first)
  redis.call('HDEL', key, 'first_failed')
  if state == 'failed' then
    local started, finished = unpack(redis.call('HMGET', key, 'started', 'finished'))
    if started and finished then redis.call('HINCRBY', key, 'idle', now() - finished) end
    redis.call('HDEL', key, 'finished')
    set_state(job, 'running')
  else
    note_standing(job)
  end
  if state ~= 'paused' then advance(job) end
elseif verb == 'priority' and ARGV[4] ~= old then
  -- Tasks that wait in the old stream are copied under a new generation; claims drop the old ones.
  -- Deleting them here, undelivered, would spoil the stream's `lag`.
  unlist(job, old)
  redis.call('HSET', key, 'priority', ARGV[4], 'gen', redis.call('INCR', 'pileus:gen'))
  note_standing(job)
  local stream = stream_of(old)
  if open and redis.call('EXISTS', stream) == 1 then
    for _, entry in ipairs(redis.call('XRANGE', stream, '(' .. group_info(stream)['last-delivered-id'], '+')) do
      local task = paired(entry[2])
      if task.job == job and task.gen == gen then send(job, task.frame, task.kind, task.part) end
    end
  end
  enlist(job)
end
return redis.call('HGET', key, 'state')
