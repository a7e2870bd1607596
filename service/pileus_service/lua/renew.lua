-- Renews the lease of the worker ARGV[2] on the entry ARGV[4] of priority ARGV[3], if it is still
-- its own. JUSTID, so that the delivery count stays the attempt count. Returns 1, or 0 if lost.
local worker, stream, id, info = ARGV[2], stream_of(ARGV[3]), ARGV[4], ARGV[5]
greet(worker, info)
if not owned(stream, id, worker) then return 0 end
redis.call('XCLAIM', stream, GROUP, worker, 0, id, 'JUSTID')
return 1
