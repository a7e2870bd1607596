-- Takes a job in (once): ARGV[3] its fields as JSON, with the frames that are done or failed.
local job, given = ARGV[2], cjson.decode(ARGV[3])
local key = job_of(job)
if redis.call('EXISTS', key) == 1 then return 0 end
redis.call('HSET', key, 'name', given.name, 'state', given.state, 'priority', given.priority,
  'life', given.life, 'frames', given.frames, 'format', FORMAT, 'created', given.created,
  'gen', redis.call('INCR', 'pileus:gen'), 'next', 0, 'done', #given.done,
  'restored', #given.done, 'samples', 0, 'tasks', 0)
note_standing(job)
if type(given.finished) == 'number' then redis.call('HSET', key, 'finished', given.finished) end
for _, frame in ipairs(given.done) do redis.call('SETBIT', key .. ':done', frame, 1) end
for frame, reason in pairs(given.failed) do note_failed(job, frame, reason) end
redis.call('ZADD', 'pileus:jobs', given.created, job)
if given.state == 'running' then advance(job) end
return 1
