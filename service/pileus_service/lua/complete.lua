-- The worker ARGV[2] has done the entry ARGV[4] of priority ARGV[3]; ARGV[5] is the result as JSON.
-- Bits make it count once, however often it was done. Returns 1, or 0 if the lease was lost.
local worker, stream, id = ARGV[2], stream_of(ARGV[3]), ARGV[4]
if not owned(stream, id, worker) then return 0 end
local task, result = read(stream, id), cjson.decode(ARGV[5])
local still_wanted = wanted(task)
local job, frame = task.job, task.frame
local key, at = job_of(job), frame_of(job, frame)
if not still_wanted then
  discard(stream, id, job)
  return 1
end
retire(stream, id, job)
count('tasks_done')
redis.call('HINCRBY', key, 'tasks', 1)

local function merge_if_whole()
  local done, tasks = unpack(redis.call('HMGET', at, 'done', 'tasks'))
  if tonumber(done) < tonumber(tasks) then return end
  redis.call('HSET', at, 'state', 'merge')
  issue(job, frame, 'merge', 0)
end

if result.replan then
  plan_frame(job, frame)
elseif task.kind == 'plan' then
  redis.call('HSET', at, 'version', result.version, 'state', 'render', 'tasks', result.tasks, 'done', #result.finished,
    'total', result.total, 'samples', result.samples)
  for _, part in ipairs(result.finished) do redis.call('SETBIT', at .. ':bits', part, 1) end
  merge_if_whole()
elseif task.kind == 'render' then
  if redis.call('SETBIT', at .. ':bits', task.part, 1) == 0 then
    redis.call('HINCRBY', at, 'done', 1)
    redis.call('HINCRBY', at, 'samples', result.samples)
    redis.call('HINCRBY', key, 'samples', result.samples)
    count('samples', result.samples)
    merge_if_whole()
  end
elseif #result.redo > 0 then
  -- Partials that the merge found missing or damaged are rendered again, a bounded number of times.
  if redis.call('HINCRBY', at, 'redos', 1) > REDOS then
    fail_frame(job, frame, 'merge failed: ' .. result.reason)
    return 1
  end
  redis.call('HSET', at, 'state', 'render')
  for _, part in ipairs(result.redo) do
    if redis.call('SETBIT', at .. ':bits', part, 0) == 1 then
      redis.call('HINCRBY', at, 'done', -1)
      issue(job, frame, 'render', part)
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
refill(job)
return 1
