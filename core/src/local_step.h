// The talk's step (Wrenninge 2015) through a medium that is taken to be everywhere as dense as
// where the step starts: Woodcock tracking with the majorant approximated by the local extinction.
#pragma once

#include "medium.h"
#include "random.h"

namespace pileus {

/// Takes a ray's origin one step of -ln(1-u)/d on, d being `local`, the extinction at the origin,
/// and u in [0, 1), and leaves the extinction there in `local`. From where there is none the ray
/// stays. Returns false where the step leads out of the volume.
inline bool take_local_step(const Medium& medium, LocalRay& ray, float u, float& local) {
    if (!(local > 0.0f)) return true;
    ray.origin = ray.at(exponential(u) / local);
    if (!medium.inside(ray.origin)) return false;
    local = medium.extinction(ray.origin);
    return true;
}

}  // namespace pileus
