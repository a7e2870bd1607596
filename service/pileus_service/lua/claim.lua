-- Gives the worker ARGV[2] (described by ARGV[3]) its next task: by priority, and in each stream
-- those whose lease ran out before new ones. Returns {priority, id, attempt, job, frame, kind, part}.
local worker, info = ARGV[2], ARGV[3]
greet(worker, info)

local function given(priority, id, attempt, task)
  redis.call('HSETNX', job_of(task.job), 'started', now())
  return { priority, id, attempt, task.job, task.frame, task.kind, task.part }
end

local function reclaim(priority, stream)
  local from = '-'
  while true do
    local expired = redis.call('XPENDING', stream, GROUP, 'IDLE', LEASE, from, '+', 32)
    for _, pending in ipairs(expired) do
      local id, owner, attempts = pending[1], pending[2], pending[4]
      local task = read(stream, id)
      if not task then
        redis.call('XACK', stream, GROUP, id)
      elseif readable(task) and not wanted(task) then
        discard(stream, id, task.job)
      elseif readable(task) and redis.call('HGET', job_of(task.job), 'state') == 'running' then
        if owner ~= RELEASED then
          record_try(stream, id, owner, 'stopped answering')
          count('leases_lost')
          redis.call('XCLAIM', stream, GROUP, RELEASED, 0, id, 'IDLE', LEASE, 'JUSTID')
        end
        local fate = suits(task, worker) and verdict(stream, id, task, attempts, worker)
        if fate == 'park' then
          park(stream, id, task)
        elseif fate == 'take' then
          redis.call('XCLAIM', stream, GROUP, worker, LEASE, id)
          return given(priority, id, attempts + 1, task)
        end
      end
      from = '(' .. id
    end
    if #expired < 32 then return nil end
  end
end

-- An entry that was delivered to us, and is for a newer worker or one of another version.
local function leave_to_others(stream, id)
  redis.call('XCLAIM', stream, GROUP, RELEASED, 0, id, 'IDLE', LEASE, 'RETRYCOUNT', 0, 'JUSTID')
end

local function take_new(priority, stream)
  while true do
    local reply = redis.call('XREADGROUP', 'GROUP', GROUP, worker, 'COUNT', 1, 'STREAMS', stream, '>')
    if not reply then return nil end
    local id = reply[1][2][1][1]
    local task = read(stream, id)
    local state, gen = unpack(redis.call('HMGET', job_of(task.job), 'state', 'gen'))
    if not readable(task) then
      leave_to_others(stream, id)
    elseif gen ~= task.gen then
      -- A copy went to another stream when the job's priority changed; this one counts for nothing.
      redis.call('XACK', stream, GROUP, id)
      redis.call('XDEL', stream, id)
    elseif not wanted(task) then
      discard(stream, id, task.job)
    elseif state == 'paused' then
      redis.call('RPUSH', job_of(task.job) .. ':held', cjson.encode({ task.frame, task.kind, task.part }))
      redis.call('XACK', stream, GROUP, id)
      redis.call('XDEL', stream, id)
    elseif not suits(task, worker) then
      leave_to_others(stream, id)
    else
      return given(priority, id, 1, task)
    end
  end
end

for priority = 9, 0, -1 do
  local stream = stream_of(priority)
  if redis.call('EXISTS', stream) == 1 then
    local task = reclaim(priority, stream) or take_new(priority, stream)
    if task then return task end
  end
end
return nil
