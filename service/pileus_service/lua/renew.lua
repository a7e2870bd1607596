-- Renews the lease of the worker ARGV[2] (described by ARGV[5]) on the entry ARGV[4] of priority
-- ARGV[3], of which it has done ARGV[6] samples, if it is still its own and still wanted. JUSTID, so
-- that the delivery count stays the attempt count. Returns 'held', 'unwanted', or 'lost'.
local worker, stream, id, info = ARGV[2], stream_of(ARGV[3]), ARGV[4], ARGV[5]
greet(worker, info)
local pending, task = owned(stream, id, worker)
if not pending then return 'lost' end
if not wanted(task) then return 'unwanted' end
redis.call('XCLAIM', stream, GROUP, worker, 0, id, 'JUSTID')
note_flight(task.job, worker, task.frame, ARGV[6])
return 'held'
