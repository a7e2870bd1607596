// Deterministic, table-free noise: every value comes from an integer hash of a lattice cell, so a
// frame is the same wherever and in whatever order it is made.
#pragma once

#include <openvdb/Types.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>

namespace pileus::noise {

using Vec3f = openvdb::Vec3s;

// A well-mixed 32-bit hash of a word.
inline std::uint32_t mix(std::uint32_t h) {
    h ^= h >> 16;
    h *= 0x7feb352dU;
    h ^= h >> 15;
    h *= 0x846ca68bU;
    h ^= h >> 16;
    return h;
}

inline std::uint32_t combine(std::uint32_t seed, std::uint32_t value) {
    return mix(seed ^ (value * 0x9e3779b9U + 0x7f4a7c15U));
}

inline std::uint32_t fold(std::uint64_t seed) {
    return combine(mix(static_cast<std::uint32_t>(seed)), static_cast<std::uint32_t>(seed >> 32));
}

// The hash of a lattice cell.
inline std::uint32_t cell_hash(std::uint32_t seed, int x, int y, int z) {
    const std::uint32_t folded = static_cast<std::uint32_t>(x) * 0x8da6b343U ^
                                 static_cast<std::uint32_t>(y) * 0xd8163841U ^
                                 static_cast<std::uint32_t>(z) * 0xcb1ab31fU;
    return mix(seed + folded);
}

// A hash as a number in [0, 1).
inline float unit(std::uint32_t h) { return static_cast<float>(h >> 8) * 0x1p-24F; }

// From 0 at `low` to 1 at `high`, flat at both ends.
inline float smoothstep(float low, float high, float x) {
    const float t = std::clamp((x - low) / (high - low), 0.0F, 1.0F);
    return t * t * (3.0F - 2.0F * t);
}

// A smooth swing between -1 and 1, once per whole number: a sine in shape, parabolas in cost.
inline float wave(float turns) {
    const float t =
        turns - static_cast<float>(static_cast<int>(turns + (turns < 0.0F ? -0.5F : 0.5F)));
    return 8.0F * t * (1.0F - 2.0F * std::abs(t));
}

// A stream of random numbers for laying out shapes. One draw a statement: the order in which a
// compiler evaluates arguments is its own.
class Random {
  public:
    explicit Random(std::uint32_t seed) : state_(seed) {}
    float operator()() { return unit(state_ = combine(state_, 0x68bc21ebU)); }
    float operator()(float low, float high) { return low + (high - low) * (*this)(); }
    // Roughly normal with unit variance and no tail beyond 3.5.
    float bell();
    Vec3f bells();
    Vec3f direction();

  private:
    std::uint32_t state_;
};

// Smoothly interpolated lattice values in [0, 1] along a line: for envelopes and profiles.
float value(float x, std::uint32_t seed);

// Gradient noise over space and time, about [-1, 1], zero mean, smooth in all four.
float gradient(const Vec3f& p, float time, std::uint32_t seed);

// Octaves of gradient noise, each half the size and half the height of the one before.
float fractal(const Vec3f& p, float time, std::uint32_t seed, int octaves);

// Points that are evaluated together, coordinate by coordinate, so that the compiler can use
// vector instructions.
constexpr std::size_t kBatch = 64;
using Values = std::array<float, kBatch>;
struct Points {
    Values x;
    Values y;
    Values z;
};

// Worley noise for a batch of neighbouring points: one lattice of feature points, each slowly
// circling in its cell, so that the field evolves without jumps.
class Worley {
  public:
    Worley(float cell, float time, std::uint32_t seed) : cell_(cell), time_(time), seed_(seed) {}
    float cell() const { return cell_; }

    // Squared distance to the nearest feature point in units of the cell, at most 1. The points
    // should lie close together: candidates are gathered once for all of them.
    Values nearest_squared(const Points& points) const;

  private:
    Vec3f feature(int x, int y, int z) const;

    float cell_;
    float time_;
    std::uint32_t seed_;
};

}  // namespace pileus::noise
