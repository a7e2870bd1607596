// What a procedural cache is asked for: which frame of how many, at what resolution, from which
// seed. Shared by every maker.
#pragma once

#include <cstdint>

namespace pileus {

// Of a cache: velocities are per second of it.
constexpr float kFramesPerSecond = 24.0F;

struct MakeOptions {
    int frame = 1;           // counted from 1
    int frames = 24;         // length of the sequence: the action is laid out over it
    int resolution = 256;    // voxels per world unit
    std::uint64_t seed = 0;  // decides the shape
};

// Throws std::invalid_argument, one line that names the option, its value and its range.
void validate(const MakeOptions& options);

}  // namespace pileus
