// Makes an animated breaking splash with spray.
#pragma once

#include "options.h"

#include <cstdint>
#include <string>

namespace pileus {

// Writes one frame of a wave that bursts into a plume of foam, jets, droplets and mist, as the
// grids `density` (0 to 1) and `velocity` (world units per second at 24 frames a second). The
// whole splash, from burst to fall, is laid out over `options.frames`.
// Returns the number of active voxels.
std::int64_t make_whitewater(const std::string& path, const MakeOptions& options);

}  // namespace pileus
