-- Shared by every script, put before each: the names of keys, the clock, and how entries are read.
-- A stream entry is {job, frame, kind, part, gen, format}; `frame` is an index into the shot's
-- frames and `part` a task of the frame's plan. FORMAT, set before all this, is the newest that we
-- can read. Only what is in flight is here; the rest waits on disk.
-- ARGV[1] is the lease in milliseconds, ARGV[2] the worker or job that the script is about.

local LEASE = tonumber(ARGV[1])
local GROUP = 'workers'
local RELEASED = 'released' -- the consumer that holds tasks which a worker gave up or lost

-- Milliseconds, by Redis's clock; the same throughout a script.
local begun_at
local function now()
  if not begun_at then
    local time = redis.call('TIME')
    begun_at = time[1] * 1000 + math.floor(time[2] / 1000)
  end
  return begun_at
end

local function stream_of(priority) return 'pileus:tasks:' .. priority end
local function ring_of(priority) return 'pileus:ring:' .. priority end
local function job_of(job) return 'pileus:job:' .. job end
local function frame_of(job, frame) return job_of(job) .. ':frame:' .. frame end
local function tries_of(stream, id) return stream .. ':tries:' .. id end

local function count(name, by) redis.call('HINCRBY', 'pileus:stats', name, by or 1) end

-- A flat list of names and values, as Redis replies, as a table.
local function paired(flat)
  local map = {}
  for i = 1, #flat, 2 do map[flat[i]] = flat[i + 1] end
  return map
end

local function introduce(worker, info)
  redis.call('SET', 'pileus:worker:' .. worker, info, 'PX', 86400000)
end

local function greet(worker, info)
  redis.call('ZADD', 'pileus:alive', now(), worker)
  introduce(worker, info)
  redis.call('HSET', 'pileus:versions', worker, cjson.decode(info).version)
  redis.call('HSET', 'pileus:formats', worker, FORMAT)
end

-- What the service compares with its disk, of all jobs in one place; a count of the changes, and at
-- which count each job changed last.
local function note_standing(job)
  local state, priority, life = unpack(redis.call('HMGET', job_of(job), 'state', 'priority', 'life'))
  redis.call('HSET', 'pileus:standing', job, state .. ' ' .. priority .. ' ' .. life)
  redis.call('ZADD', 'pileus:changed', redis.call('INCR', 'pileus:changes'), job)
end

local function set_state(job, state)
  redis.call('HSET', job_of(job), 'state', state)
  note_standing(job)
end

-- An entry's fields, or nil where it has been deleted.
local function read(stream, id)
  local found = redis.call('XRANGE', stream, id, id)[1]
  return found and paired(found[2])
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

-- The pending record of an entry and its task if the worker owns it, else nil; one that a keeper has
-- deleted is nobody's.
local function owned(stream, id, worker)
  if redis.call('EXISTS', stream) == 0 then return nil end
  local pending = redis.call('XPENDING', stream, GROUP, id, id, 1)[1]
  if not pending or pending[2] ~= worker then return nil end
  local task = read(stream, id)
  if task then return pending, task end
  redis.call('XACK', stream, GROUP, id)
end

-- What an in-flight task has rendered, for the job's progress.
local function note_flight(job, worker, frame, samples)
  redis.call('HSET', job_of(job) .. ':flight', worker, frame .. ' ' .. samples)
end

local function land(job, worker) redis.call('HDEL', job_of(job) .. ':flight', worker) end

-- Takes an entry out of its stream for good; deleting only delivered ones keeps `lag` true.
local function retire(stream, id)
  redis.call('XACK', stream, GROUP, id)
  redis.call('XDEL', stream, id)
  redis.call('DEL', tries_of(stream, id))
end
