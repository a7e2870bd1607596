-- Shared by every script, put before each: key names and the life of a job's frames and tasks.
-- A stream entry is {job, frame, kind, part, gen, format}; `frame` is an index into the shot's frames
-- and `part` a task of the frame's plan. FORMAT, set before all this, is the newest that we can read. Only what is in flight is here; the rest waits on disk.
-- ARGV[1] is the lease in milliseconds, ARGV[2] the worker or job that the script is about.

local LEASE = tonumber(ARGV[1])
local GROUP = 'workers'
local RELEASED = 'released' -- the consumer that holds tasks which a worker gave up
local ATTEMPTS = 3
local REDOS = 3

local function now()
  local time = redis.call('TIME')
  return time[1] * 1000 + math.floor(time[2] / 1000)
end

local function stream_of(priority) return 'pileus:tasks:' .. priority end
local function job_of(job) return 'pileus:job:' .. job end
local function frame_of(job, frame) return job_of(job) .. ':frame:' .. frame end
local function tries_of(stream, id) return stream .. ':tries:' .. id end

local function count(name, by) redis.call('HINCRBY', 'pileus:stats', name, by or 1) end

local function fields(key)
  local flat, map = redis.call('HGETALL', key), {}
  for i = 1, #flat, 2 do map[flat[i]] = flat[i + 1] end
  return map
end

local function live_workers()
  return redis.call('ZRANGEBYSCORE', 'pileus:alive', now() - LEASE, '+inf')
end

local function send(job, frame, kind, part)
  local priority, gen, format = unpack(redis.call('HMGET', job_of(job), 'priority', 'gen', 'format'))
  local stream = stream_of(priority)
  if redis.call('EXISTS', stream) == 0 then
    redis.call('XGROUP', 'CREATE', stream, GROUP, '0', 'MKSTREAM')
  end
  redis.call('XADD', stream, '*', 'job', job, 'frame', frame, 'kind', kind, 'part', part, 'gen', gen,
    'format', format)
end

-- Issues a task anew: it counts as outstanding until it is retired.
local function issue(job, frame, kind, part)
  redis.call('HINCRBY', job_of(job), 'out', 1)
  send(job, frame, kind, part)
end

-- Begins a frame, or begins it again with nothing kept.
local function plan_frame(job, frame)
  local at = frame_of(job, frame)
  redis.call('DEL', at, at .. ':bits')
  redis.call('HSET', at, 'state', 'plan', 'tasks', 0, 'issued', 0, 'done', 0, 'redos', 0, 'samples', 0,
    'total', 0, 'started', now())
  issue(job, frame, 'plan', 0)
end

-- Takes an entry out of its stream for good; deleting only delivered ones keeps `lag` true.
local function retire(stream, id, job)
  if redis.call('XACK', stream, GROUP, id) == 0 then return end
  redis.call('XDEL', stream, id)
  redis.call('DEL', tries_of(stream, id))
  if redis.call('EXISTS', job_of(job)) == 1 then redis.call('HINCRBY', job_of(job), 'out', -1) end
end

-- Issues what the window has room for: tasks of planned frames first, then the plan of the next.
local function refill(job)
  local key = job_of(job)
  if redis.call('HGET', key, 'state') ~= 'running' then return end
  local workers = #live_workers()
  local out = tonumber(redis.call('HGET', key, 'out'))
  local room = math.max(8, 2 * workers) - out
  local active = redis.call('ZRANGE', key .. ':active', 0, -1)
  for _, frame in ipairs(active) do
    if room <= 0 then return end
    local at = frame_of(job, frame)
    local state, tasks, issued = unpack(redis.call('HMGET', at, 'state', 'tasks', 'issued'))
    tasks, issued = tonumber(tasks), tonumber(issued)
    while state == 'render' and room > 0 and issued < tasks do
      if redis.call('GETBIT', at .. ':bits', issued) == 0 then
        issue(job, frame, 'render', issued)
        room = room - 1
      end
      issued = redis.call('HINCRBY', at, 'issued', 1)
    end
  end
  local frames, coming = unpack(redis.call('HMGET', key, 'frames', 'next'))
  frames, coming = tonumber(frames), tonumber(coming)
  local frame_room = math.min(64, math.max(2, workers + 1)) - #active
  while room > 0 and frame_room > 0 and coming < frames do
    local settled = redis.call('GETBIT', key .. ':done', coming) == 1
      or redis.call('HEXISTS', key .. ':failed', coming) == 1
    if not settled then
      redis.call('ZADD', key .. ':active', coming, coming)
      plan_frame(job, coming)
      room, frame_room = room - 1, frame_room - 1
    end
    coming = coming + 1
  end
  redis.call('HSET', key, 'next', coming)
end

-- Drops a task that nobody waits for any more; the room it took goes to others of its job.
local function discard(stream, id, job)
  retire(stream, id, job)
  refill(job)
end

local function forget_frame(job, frame)
  redis.call('DEL', frame_of(job, frame), frame_of(job, frame) .. ':bits')
  redis.call('ZREM', job_of(job) .. ':active', frame)
end

-- Ends the job when its last frame has ended, else goes on with the next.
local function advance(job)
  local key = job_of(job)
  local frames, done = unpack(redis.call('HMGET', key, 'frames', 'done'))
  local failed = redis.call('HLEN', key .. ':failed')
  if tonumber(done) + failed >= tonumber(frames) then
    redis.call('HSET', key, 'state', failed > 0 and 'failed' or 'done', 'finished', now())
  else
    refill(job)
  end
end

local function fail_frame(job, frame, reason)
  redis.call('HSET', job_of(job) .. ':failed', frame, reason)
  forget_frame(job, frame)
  count('frames_failed')
  advance(job)
end

-- Whether a task may go to a worker: a frame's parts and merge are for the version that planned it, as
-- long as a worker of that version lives.
local function suits(task, worker)
  local planned = redis.call('HGET', frame_of(task.job, task.frame), 'version')
  if not planned or planned == redis.call('HGET', 'pileus:versions', worker) then return true end
  for _, other in ipairs(live_workers()) do
    if planned == redis.call('HGET', 'pileus:versions', other) then return false end
  end
  return true
end

-- What an attempt's failure leads to for the worker that asks: 'take', 'skip' or 'park'.
-- The delivery count is the attempt count. The attempts go to distinct workers while such live.
local function verdict(stream, id, task, deliveries, worker)
  local tries = tries_of(stream, id)
  if redis.call('HLEN', tries) >= ATTEMPTS then return 'park' end
  if redis.call('HEXISTS', tries, worker) == 0 then return 'take' end
  for _, other in ipairs(live_workers()) do
    if redis.call('HEXISTS', tries, other) == 0 and suits(task, other) then return 'skip' end
  end
  return deliveries >= ATTEMPTS and 'park' or 'take'
end

local function record_try(stream, id, worker, reason)
  redis.call('HSET', tries_of(stream, id), worker, reason)
  redis.call('EXPIRE', tries_of(stream, id), 86400)
  count('attempts_failed')
end

-- Parks a task: it is taken out of its stream and its frame fails, with each worker's reason.
local function park(stream, id, task)
  local reasons = {}
  for worker, reason in pairs(fields(tries_of(stream, id))) do
    reasons[#reasons + 1] = worker .. ': ' .. reason
  end
  table.sort(reasons)
  retire(stream, id, task.job)
  count('tasks_parked')
  fail_frame(task.job, task.frame, task.kind .. ' failed: ' .. table.concat(reasons, '; '))
end

-- An entry's fields, or nil where it has been deleted.
local function read(stream, id)
  local found = redis.call('XRANGE', stream, id, id)[1]
  if not found then return nil end
  local task = {}
  for i = 1, #found[2], 2 do task[found[2][i]] = found[2][i + 1] end
  return task
end

-- Whether we know what the task says; a newer worker will.
local function readable(task) return tonumber(task.format) <= FORMAT end

-- Whether the job still waits for this task: not cancelled, not done already, frame not failed.
local function wanted(task)
  local state = redis.call('HGET', job_of(task.job), 'state')
  if state ~= 'running' and state ~= 'paused' then return false end
  local at = frame_of(task.job, task.frame)
  local stage, tasks = unpack(redis.call('HMGET', at, 'state', 'tasks'))
  if stage ~= task.kind then return false end
  if task.kind ~= 'render' then return true end
  return tonumber(task.part) < tonumber(tasks) and redis.call('GETBIT', at .. ':bits', task.part) == 0
end

-- The pending record of an entry if the worker owns it, else nil.
local function owned(stream, id, worker)
  if redis.call('EXISTS', stream) == 0 then return nil end
  local pending = redis.call('XPENDING', stream, GROUP, id, id, 1)[1]
  return pending and pending[2] == worker and pending or nil
end

local function greet(worker, info)
  redis.call('ZADD', 'pileus:alive', now(), worker)
  redis.call('SET', 'pileus:worker:' .. worker, info, 'PX', 86400000)
  redis.call('HSET', 'pileus:versions', worker, cjson.decode(info).version)
end
