-- Gives the worker ARGV[2] (described by ARGV[3]) its next task: by priority, and in each stream
-- those whose lease ran out before new ones. Returns {priority, id, attempt, job, frame, kind, part}.
-- A worker that is not able to do one (ARGV[4] is not 1) gets none; ARGV[5] is its trouble, if it has any,
-- and ARGV[6] the farm of its data folder.
local SWEEP = 250 -- milliseconds between looks for leases that ran out
local LOOKS = 128 -- released tasks that one claim looks at, in each stream
local TROUBLED = 3000 -- milliseconds for which a worker with trouble is set aside, and each time again
local worker, info, able, trouble, farm = ARGV[2], ARGV[3], ARGV[4], ARGV[5], ARGV[6]

local function each_stream(act)
  for priority = 9, 0, -1 do
    local stream = stream_of(priority)
    if redis.call('EXISTS', stream) == 1 then act(stream) end
  end
end

-- A worker that claims has nothing in hand: what is its own is of a claim whose answer it did not hear.
local function hand_back_unheard()
  each_stream(function(stream)
    for _, pending in ipairs(redis.call('XPENDING', stream, GROUP, '-', '+', 32, worker)) do
      local id, deliveries = pending[1], pending[4]
      local task = read(stream, id)
      if task then
        hand_back(stream, id, task, deliveries, worker)
      else
        redis.call('XACK', stream, GROUP, id)
      end
    end
  end)
end

local function each_pending(stream, idle, act)
  local from = '-'
  while true do
    local page = redis.call('XPENDING', stream, GROUP, 'IDLE', idle, from, '+', 128)
    for _, pending in ipairs(page) do act(pending[1], pending[2]) end
    if #page < 128 then return end
    from = '(' .. page[#page][1]
  end
end

-- Whether the age of leases says nothing of those who hold them. A clock set back would make each
-- last that much longer. And where no worker at all was heard of in the time within which all renew
-- theirs (each 2.5 s of 10), it was Redis that was away, or its clock that jumped.
local function leases_are_void(time, last)
  local heard = tonumber(redis.call('ZRANGE', 'pileus:alive', -1, -1, 'WITHSCORES')[2] or time)
  return time < last - 1000 or time > heard + 0.75 * LEASE
end

-- All leases begin anew from here.
local function begin_leases_anew(time)
  each_stream(function(stream)
    each_pending(stream, 0, function(id, owner)
      redis.call('XCLAIM', stream, GROUP, owner, 0, id, 'IDLE', 0, 'JUSTID')
    end)
  end)
  for key, most in pairs({ ['pileus:alive'] = 0, ['pileus:due'] = 0, ['pileus:aside'] = ASIDE }) do
    for _, member in ipairs(redis.call('ZRANGEBYSCORE', key, '(' .. time + most, '(+inf')) do
      redis.call('ZADD', key, time + most, member)
    end
  end
end

-- Takes leases that ran out from those that held them.
local function take_expired()
  each_stream(function(stream)
    each_pending(stream, LEASE, function(id, owner)
      if owner == RELEASED then return end
      record_try(stream, id, owner, 'stopped answering')
      count('leases_lost')
      redis.call('XCLAIM', stream, GROUP, RELEASED, 0, id, 'JUSTID')
      local task = read(stream, id)
      if task then land(task.job, owner) end
    end)
  end)
end

-- Looks again for the caches that frames wait for.
local function wake(time)
  for _, member in ipairs(redis.call('ZRANGEBYSCORE', 'pileus:due', '-inf', time, 'LIMIT', 0, 64)) do
    local job, frame = member:match('^(%S+) (%d+)$')
    local state = redis.call('HGET', job_of(job), 'state')
    if state == 'paused' then
      redis.call('ZADD', 'pileus:due', time + 5000, member)
    else
      redis.call('ZREM', 'pileus:due', member)
      if redis.call('HDEL', job_of(job) .. ':waiting', frame) == 1 and state == 'running' then
        open_frame(job, frame, 0)
      end
    end
  end
end

local function look_around()
  local time, last = now(), tonumber(redis.call('GET', 'pileus:clock') or 0)
  if time >= last and time < last + SWEEP then return end
  redis.call('SET', 'pileus:clock', time)
  if leases_are_void(time, last) then begin_leases_anew(time) end
  take_expired()
  wake(time)
end

-- The worker is shown at its task from here on, not only from the first time that it renews the lease:
-- many a task is done by then.
local function show_at_work(priority, id, attempt, task)
  local told = cjson.decode(info)
  told.task = { priority = priority, entry = id, attempt = attempt, job = task.job,
    frame = tonumber(task.frame), kind = task.kind, part = tonumber(task.part) }
  introduce(worker, cjson.encode(told))
end

local function given(priority, id, attempt, task)
  redis.call('HSETNX', job_of(task.job), 'started', now())
  show_at_work(priority, id, attempt, task)
  return { priority, id, attempt, task.job, task.frame, task.kind, task.part }
end

-- Puts a paused job's task aside until it is resumed.
local function hold(stream, id, task)
  redis.call('RPUSH', job_of(task.job) .. ':held', cjson.encode({ task.frame, task.kind, task.part }))
  retire(stream, id)
end

local function suits_us(job, frame) return suits(job, frame, worker) end

-- The released tasks that a claim looks at: of many some, and the next time those from there on, so that
-- a worker comes to all of them.
local function some_released(priority, stream)
  local page = redis.call('XPENDING', stream, GROUP, '-', '+', LOOKS, RELEASED)
  if #page < LOOKS then return page end
  local place = 'pileus:looked:' .. priority .. ':' .. worker
  page = redis.call('XPENDING', stream, GROUP, redis.call('GET', place) or '-', '+', LOOKS, RELEASED)
  if #page < LOOKS then
    redis.call('DEL', place)
  else
    redis.call('SET', place, '(' .. page[LOOKS][1], 'PX', LEASE)
  end
  return page
end

local function take_released(priority, stream)
  for _, pending in ipairs(some_released(priority, stream)) do
    local id, attempts = pending[1], pending[4]
    local task = read(stream, id)
    if not task then
      redis.call('XACK', stream, GROUP, id)
    elseif not readable(task) then
      -- A newer worker's: it stays where it is.
    elseif not wanted(task) then
      retire(stream, id)
    elseif redis.call('HGET', job_of(task.job), 'state') == 'paused' then
      hold(stream, id, task)
    else
      local fate = suits_us(task.job, task.frame) and verdict(stream, id, task, attempts, worker)
      if fate == 'park' then
        park(stream, id, task)
      elseif fate == 'take' then
        redis.call('XCLAIM', stream, GROUP, worker, 0, id)
        return given(priority, id, attempts + 1, task)
      end
    end
  end
end

-- An entry that was delivered to us, and is for a newer worker or one of another version.
local function leave_to_others(stream, id)
  redis.call('XCLAIM', stream, GROUP, RELEASED, 0, id, 'RETRYCOUNT', 0, 'JUSTID')
end

local function take_new(priority, stream)
  while true do
    local reply = redis.call('XREADGROUP', 'GROUP', GROUP, worker, 'COUNT', 1, 'STREAMS', stream, '>')
    if not reply then return nil end
    local id, flat = unpack(reply[1][2][1])
    local task = paired(flat)
    local state, gen = unpack(redis.call('HMGET', job_of(task.job), 'state', 'gen'))
    if not readable(task) then
      leave_to_others(stream, id)
    elseif gen ~= task.gen or not wanted(task) then
      -- Nobody waits for it; or a copy went to another stream when the job's priority changed.
      retire(stream, id)
    elseif state == 'paused' then
      hold(stream, id, task)
    elseif not suits_us(task.job, task.frame) then
      leave_to_others(stream, id)
    else
      return given(priority, id, 1, task)
    end
  end
end

hand_back_unheard()
look_around()
greet(worker, info)
-- Where its data folder is another, or is not mounted, it would fail whatever it took. While it still
-- starts it may have looked there before the service began the farm.
local ours = redis.call('GET', 'pileus:farm')
if able == '1' and ours and ours ~= farm then
  trouble = "its data folder is not the farm's: is it mounted?"
end
if trouble ~= '' then set_aside(worker, TROUBLED, trouble) end
if able ~= '1' or aside(worker) then return nil end
for priority = 9, 0, -1 do
  local stream = stream_of(priority)
  if redis.call('EXISTS', stream) == 1 then
    local task = take_released(priority, stream) or take_new(priority, stream)
    if not task and redis.call('EXISTS', ring_of(priority)) == 1 then
      refill(priority)
      task = take_new(priority, stream)
      if not task and issue_for(priority, suits_us) then task = take_new(priority, stream) end
    end
    if task then return task end
  end
end
return nil
