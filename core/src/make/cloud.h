// Makes an animated fractal cumulus.
#pragma once

#include "options.h"

#include <cstdint>
#include <string>

namespace pileus {

// Writes one frame of a drifting, billowing cumulus, about one world unit wide around the origin,
// as the grids `density` (0 to 1) and `velocity` (world units per second at 24 frames a second).
// Returns the number of active voxels.
std::int64_t make_cloud(const std::string& path, const MakeOptions& options);

}  // namespace pileus
