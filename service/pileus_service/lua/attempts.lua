-- Put after issue.lua: attempts that failed, what they lead to, and workers on which all fail.

local ATTEMPTS = 3
local STRIKES = 3 -- tasks that failed on a worker and then went well on another
local ASIDE = 300000 -- milliseconds for which such a worker gets nothing

-- Whether a worker gets no tasks: set aside for a time, or drained (without end).
local function aside(worker)
  local until_then = redis.call('ZSCORE', 'pileus:aside', worker)
  return until_then and (until_then == 'inf' or tonumber(until_then) > now())
end

local function set_aside(worker, milliseconds, reason)
  if aside(worker) then return end
  redis.call('ZADD', 'pileus:aside', now() + milliseconds, worker)
  redis.call('HSET', 'pileus:aside:why', worker, reason)
end

local function live_workers()
  return redis.call('ZRANGEBYSCORE', 'pileus:alive', now() - LEASE, '+inf')
end

-- The versions of the workers that live, asked for once in a script.
local live
local function lives(version)
  if not live then
    live = {}
    for _, worker in ipairs(live_workers()) do
      live[redis.call('HGET', 'pileus:versions', worker) or ''] = true
    end
  end
  return live[version]
end

-- Whether a frame's tasks may go to a worker: its parts and merge are for the version that planned it,
-- as long as a worker of that version lives.
local function suits(job, frame, worker)
  local planned = redis.call('HGET', frame_of(job, frame), 'version')
  return not planned or planned == redis.call('HGET', 'pileus:versions', worker) or not lives(planned)
end

-- Whether a worker knows what a task says; until formats were told there was but the first.
local function reads(worker, task)
  return tonumber(task.format) <= tonumber(redis.call('HGET', 'pileus:formats', worker) or 1)
end

-- What an attempt's failure leads to for the worker that asks: 'take', 'skip' or 'park'.
-- The delivery count is the attempt count. The attempts go to distinct workers while such live.
local function verdict(stream, id, task, deliveries, worker)
  local tries = tries_of(stream, id)
  if redis.call('HLEN', tries) >= ATTEMPTS then return 'park' end
  if redis.call('HEXISTS', tries, worker) == 0 then return 'take' end
  for _, other in ipairs(live_workers()) do
    if redis.call('HEXISTS', tries, other) == 0 and not aside(other) and reads(other, task)
        and suits(task.job, task.frame, other) then
      return 'skip'
    end
  end
  return deliveries >= ATTEMPTS and 'park' or 'take'
end

-- Takes a task from a worker untried, for any to take at once: no attempt is counted.
local function hand_back(stream, id, task, deliveries, worker)
  land(task.job, worker)
  if wanted(task) then
    redis.call('XCLAIM', stream, GROUP, RELEASED, 0, id, 'RETRYCOUNT', deliveries - 1, 'JUSTID')
  else
    retire(stream, id)
  end
end

local function record_try(stream, id, worker, reason)
  redis.call('HSET', tries_of(stream, id), worker, reason)
  redis.call('EXPIRE', tries_of(stream, id), 86400)
  count('attempts_failed')
end

-- A task has gone well: so it was the fault of those on whom it failed before, and not its own.
local function blame(stream, id, worker)
  redis.call('HDEL', 'pileus:strikes', worker)
  for other, reason in pairs(paired(redis.call('HGETALL', tries_of(stream, id)))) do
    if other ~= worker and redis.call('HINCRBY', 'pileus:strikes', other, 1) >= STRIKES then
      redis.call('HDEL', 'pileus:strikes', other)
      set_aside(other, ASIDE,
        STRIKES .. ' tasks failed here and went well elsewhere; the last: ' .. reason)
      count('workers_set_aside')
    end
  end
end

-- Parks a task: it is taken out of its stream and its frame fails, with each worker's reason.
local function park(stream, id, task)
  local reasons = {}
  for worker, reason in pairs(paired(redis.call('HGETALL', tries_of(stream, id)))) do
    reasons[#reasons + 1] = worker .. ': ' .. reason
  end
  table.sort(reasons)
  retire(stream, id)
  count('tasks_parked')
  fail_frame(task.job, task.frame, task.kind .. ' failed: ' .. table.concat(reasons, '; '))
end
