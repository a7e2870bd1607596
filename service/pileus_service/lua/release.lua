-- The worker ARGV[2] gives up the entry ARGV[4] of priority ARGV[3], to be taken by another at once.
-- With a reason ARGV[5] its attempt failed; without one it is handed back and the attempt is
-- not counted. Returns 'released', 'parked', or 'lost' if it was not the worker's any more.
local worker, stream, id, reason = ARGV[2], stream_of(ARGV[3]), ARGV[4], ARGV[5]
local pending, task = owned(stream, id, worker)
if not pending then return 'lost' end
local attempts = pending[4]
if reason == '' or not wanted(task) then
  hand_back(stream, id, task, attempts, worker)
else
  land(task.job, worker)
  record_try(stream, id, worker, reason)
  if verdict(stream, id, task, attempts, worker) == 'park' then
    park(stream, id, task)
    return 'parked'
  end
  redis.call('XCLAIM', stream, GROUP, RELEASED, 0, id, 'JUSTID')
end
return 'released'
