-- The worker ARGV[2] has done the entry ARGV[4] of priority ARGV[3]; ARGV[5] is the result as JSON.
-- Bits make it count once, however often it was done. Returns 1, or 0 if the lease was lost.
local REDOS = 3
local LOOK_AGAIN = 5000 -- milliseconds until a missing cache is looked for again, at least
local worker, stream, id = ARGV[2], stream_of(ARGV[3]), ARGV[4]
local pending, task = owned(stream, id, worker)
if not pending then return 0 end
local result = cjson.decode(ARGV[5])
local job, frame = task.job, task.frame
local key, at = job_of(job), frame_of(job, frame)
local still_wanted = wanted(task)
land(job, worker)
blame(stream, id, worker)
retire(stream, id)
if not still_wanted then
  refill(ARGV[3])
  return 1
end
count('tasks_done')
redis.call('HINCRBY', key, 'tasks', 1)

local function merge_if_whole()
  local done, tasks = unpack(redis.call('HMGET', at, 'done', 'tasks'))
  if tonumber(done) < tonumber(tasks) then return end
  redis.call('HSET', at, 'state', 'merge')
  redis.call('ZREM', key .. ':ready', frame)
  send(job, frame, 'merge', 0)
end

-- Counts how often a frame has been set back; false, and the frame fails, if that is too often.
local function set_back(reason)
  local redos = redis.call('HINCRBY', at, 'redos', 1)
  if redos <= REDOS then return redos end
  fail_frame(job, frame, task.kind .. ' failed: ' .. reason)
  return nil
end

if result.wait then
  -- The more frames wait, the more seldom each is looked for: ten a second for a job at most.
  forget_frame(job, frame)
  redis.call('HSET', key .. ':waiting', frame, result.wait)
  local pause = math.max(LOOK_AGAIN, 100 * redis.call('HLEN', key .. ':waiting'))
  redis.call('ZADD', 'pileus:due', now() + pause, job .. ' ' .. frame)
elseif result.replan then
  open_frame(job, frame, 0)
elseif result.stale then
  local redos = set_back(result.stale)
  if not redos then return 1 end
  open_frame(job, frame, redos)
elseif task.kind == 'plan' then
  redis.call('HSET', at, 'version', result.version, 'state', 'render', 'tasks', result.tasks,
    'done', #result.finished, 'total', result.total, 'samples', result.samples)
  for _, part in ipairs(result.finished) do redis.call('SETBIT', at .. ':bits', part, 1) end
  if result.tasks > #result.finished then redis.call('ZADD', key .. ':ready', frame, frame) end
  merge_if_whole()
elseif task.kind == 'render' then
  if redis.call('SETBIT', at .. ':bits', task.part, 1) == 0 then
    redis.call('HINCRBY', at, 'done', 1)
    redis.call('HINCRBY', at, 'samples', result.samples)
    local taken = result.taken or result.samples  -- an older worker tells only these
    redis.call('HINCRBY', key, 'samples', taken)
    count('samples', taken)
    merge_if_whole()
  end
elseif #result.redo > 0 then
  -- Partials that the merge found missing or damaged are rendered again, a bounded number of times.
  if not set_back(result.reason) then return 1 end
  redis.call('HSET', at, 'state', 'render')
  for _, part in ipairs(result.redo) do
    if redis.call('SETBIT', at .. ':bits', part, 0) == 1 then
      redis.call('HINCRBY', at, 'done', -1)
      send(job, frame, 'render', part)
    end
  end
else
  redis.call('SETBIT', key .. ':done', frame, 1)
  redis.call('HINCRBY', key, 'done', 1)
  forget_frame(job, frame)
  count('frames_done')
  advance(job)
  return 1
end
enlist(job)
return 1
