-- Put after common.lua: how jobs' tasks come into the streams. Each priority has a ring of the jobs
-- that have something to issue; a stream is kept filled a window ahead of its workers, one task a
-- job in turn. So equals share, and what waits in Redis grows with the workers, never with the jobs.

local FRAMES = 1024 -- frames of one job in flight, at most
local JOBS = 16 -- that are asked in one go for a task of a kind

local function alive() return redis.call('ZCOUNT', 'pileus:alive', now() - LEASE, '+inf') end

local function group_info(stream)
  return paired(redis.call('XINFO', 'GROUPS', stream)[1])
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

-- Begins a frame, or begins it anew: its plan is the first task.
local function open_frame(job, frame, redos)
  local at = frame_of(job, frame)
  redis.call('DEL', at, at .. ':bits')
  redis.call('ZREM', job_of(job) .. ':ready', frame)
  redis.call('ZADD', job_of(job) .. ':active', frame, frame)
  redis.call('HSET', at, 'state', 'plan', 'tasks', 0, 'issued', 0, 'done', 0, 'redos', redos,
    'samples', 0, 'total', 0)
  send(job, frame, 'plan', 0)
end

local function forget_frame(job, frame)
  local key = job_of(job)
  redis.call('DEL', frame_of(job, frame), frame_of(job, frame) .. ':bits')
  redis.call('ZREM', key .. ':active', frame)
  redis.call('ZREM', key .. ':ready', frame)
end

-- Whether a frame has ended, is in flight, or waits for its cache.
local function begun(key, frame)
  return redis.call('GETBIT', key .. ':done', frame) == 1
    or redis.call('HEXISTS', key .. ':failed', frame) == 1
    or redis.call('HEXISTS', key .. ':waiting', frame) == 1
    or redis.call('ZSCORE', key .. ':active', frame) and true or false
end

-- The first of a job's planned frames that has tasks to issue; of those that suit, where that is asked.
local function next_ready(job, suiting)
  for _, frame in ipairs(redis.call('ZRANGE', job_of(job) .. ':ready', 0, suiting and -1 or 0)) do
    if not suiting or suiting(job, frame) then return frame end
  end
end

-- Issues one task of a job: of a planned frame if there is one, else the plan of the next frame.
local function issue_one(job, suiting)
  local key = job_of(job)
  if redis.call('HGET', key, 'state') ~= 'running' then return false end
  while true do
    local frame = next_ready(job, suiting)
    if not frame then break end
    local at = frame_of(job, frame)
    local tasks, part = unpack(redis.call('HMGET', at, 'tasks', 'issued'))
    tasks, part = tonumber(tasks), tonumber(part)
    while part < tasks and redis.call('GETBIT', at .. ':bits', part) == 1 do part = part + 1 end
    redis.call('HSET', at, 'issued', math.min(tasks, part + 1))
    if part + 1 >= tasks then redis.call('ZREM', key .. ':ready', frame) end
    if part < tasks then
      send(job, frame, 'render', part)
      return true
    end
  end
  if redis.call('ZCARD', key .. ':active') >= math.min(FRAMES, math.max(2, alive() + 1)) then return false end
  local frames, coming = unpack(redis.call('HMGET', key, 'frames', 'next'))
  frames, coming = tonumber(frames), tonumber(coming)
  while coming < frames and begun(key, coming) do coming = coming + 1 end
  redis.call('HSET', key, 'next', math.min(frames, coming + 1))
  if coming >= frames then return false end
  open_frame(job, coming, 0)
  return true
end

-- Fills a priority's stream up to its window, a task a job in turn. What was released waits as well: the
-- worker that it is for may be one of many.
local function refill(priority)
  local stream, ring = stream_of(priority), ring_of(priority)
  local room = math.max(8, 2 * alive())
  if redis.call('EXISTS', stream) == 1 then
    room = room - (redis.call('XLEN', stream) - group_info(stream)['pending'])
    if room > 0 then room = room - #redis.call('XPENDING', stream, GROUP, '-', '+', room, RELEASED) end
  end
  while room > 0 do
    local job = redis.call('LPOP', ring)
    if not job then return end
    if issue_one(job) then
      redis.call('RPUSH', ring, job)
      room = room - 1
    elseif redis.call('EXISTS', job_of(job)) == 1 then
      redis.call('HDEL', job_of(job), 'ringed')
    end
  end
end

-- Issues one task that suits a worker for which all that waits is for others.
local function issue_for(priority, suiting)
  local ring = ring_of(priority)
  for _, job in ipairs(redis.call('LRANGE', ring, 0, JOBS - 1)) do
    redis.call('RPUSH', ring, redis.call('LPOP', ring))
    if issue_one(job, suiting) then return true end
  end
  return false
end

-- Says that a job may have something to issue.
local function enlist(job)
  local state, priority = unpack(redis.call('HMGET', job_of(job), 'state', 'priority'))
  if state ~= 'running' then return end
  if redis.call('HSETNX', job_of(job), 'ringed', 1) == 1 then
    redis.call('RPUSH', ring_of(priority), job)
  end
  refill(priority)
end

-- Takes a job out of its ring, where it changes its priority or goes.
local function unlist(job, priority)
  redis.call('LREM', ring_of(priority), 0, job)
  redis.call('HDEL', job_of(job), 'ringed')
end

-- Ends the job when its last frame has ended, else goes on with the next.
local function advance(job)
  local key = job_of(job)
  local frames, done = unpack(redis.call('HMGET', key, 'frames', 'done'))
  local failed = redis.call('HLEN', key .. ':failed')
  if tonumber(done) + failed >= tonumber(frames) then
    redis.call('HSET', key, 'finished', now())
    set_state(job, failed > 0 and 'failed' or 'done')
    redis.call('DEL', key .. ':flight')
  else
    enlist(job)
  end
end

-- Which failed first is kept: a look at a job is not to go through all of a hundred thousand.
local function note_failed(job, frame, reason)
  local key = job_of(job)
  redis.call('HSET', key .. ':failed', frame, reason)
  local first = tonumber(redis.call('HGET', key, 'first_failed') or frame)
  redis.call('HSET', key, 'first_failed', math.min(first, tonumber(frame)))
end

local function fail_frame(job, frame, reason)
  note_failed(job, frame, reason)
  forget_frame(job, frame)
  count('frames_failed')
  advance(job)
end
