// A cumulus as a heap of puffs: a few dozen large spheres stacked into towers on a flat base, each
// budding smaller ones.
#pragma once

#include <openvdb/openvdb.h>

#include <cstdint>
#include <vector>

namespace pileus::make {

constexpr float kBase = -0.20F;  // height of the flat underside

struct Puff {
    openvdb::Vec3s centre;
    float radius;
};

// All puffs at a time in seconds. All motion is a smooth function of it, so any frame stands alone.
std::vector<Puff> heap(std::uint32_t seed, float time);

}  // namespace pileus::make
