// Gradient, value and Worley noise from integer hashes.
#include "noise.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>
#include <vector>

namespace pileus::noise {
namespace {

constexpr float kTau = 6.28318530718F;

float fade(float t) { return t * t * t * (t * (t * 6.0F - 15.0F) + 10.0F); }

float lerp(float a, float b, float t) { return a + (b - a) * t; }

// Dot product of the offset with one of the 32 diagonals that have three equal coordinates and a
// zero: two bits choose the zero, three the signs.
float slope(std::uint32_t h, float x, float y, float z, float w) {
    float a = x;
    float b = y;
    float c = z;
    switch (h >> 30) {
        case 0:
            a = w;
            break;
        case 1:
            b = w;
            break;
        case 2:
            c = w;
            break;
        default:
            break;
    }
    return ((h & 1U) != 0U ? a : -a) + ((h & 2U) != 0U ? b : -b) + ((h & 4U) != 0U ? c : -c);
}

}  // namespace

float Random::bell() {
    float sum = -2.0F;
    for (int i = 0; i < 4; ++i) sum += (*this)();
    return sum * std::sqrt(3.0F);
}

Vec3f Random::bells() {
    Vec3f v;
    for (int axis = 0; axis < 3; ++axis) v[axis] = bell();
    return v;
}

Vec3f Random::direction() {
    const float y = (*this)(-1.0F, 1.0F);
    const float angle = (*this)() * kTau;
    const float r = std::sqrt(std::max(0.0F, 1.0F - y * y));
    return {r * std::cos(angle), y, r * std::sin(angle)};
}

float value(float x, std::uint32_t seed) {
    const float cell = std::floor(x);
    const int i = static_cast<int>(cell);
    return lerp(unit(cell_hash(seed, i, 0, 0)), unit(cell_hash(seed, i + 1, 0, 0)), fade(x - cell));
}

float gradient(const Vec3f& p, float time, std::uint32_t seed) {
    const float fx = std::floor(p.x());
    const float fy = std::floor(p.y());
    const float fz = std::floor(p.z());
    const float fw = std::floor(time);
    const int ix = static_cast<int>(fx);
    const int iy = static_cast<int>(fy);
    const int iz = static_cast<int>(fz);
    const float x = p.x() - fx;
    const float y = p.y() - fy;
    const float z = p.z() - fz;
    const float w = time - fw;
    const float u = fade(x);
    const float v = fade(y);
    const float s = fade(z);
    std::array<float, 2> slab{};
    for (int dw = 0; dw < 2; ++dw) {
        const std::uint32_t layer =
            combine(seed, static_cast<std::uint32_t>(static_cast<int>(fw) + dw));
        const float tw = w - static_cast<float>(dw);
        const auto corner = [&](int dx, int dy, int dz) {
            return slope(cell_hash(layer, ix + dx, iy + dy, iz + dz), x - static_cast<float>(dx),
                         y - static_cast<float>(dy), z - static_cast<float>(dz), tw);
        };
        const float near = lerp(lerp(corner(0, 0, 0), corner(1, 0, 0), u),
                                lerp(corner(0, 1, 0), corner(1, 1, 0), u), v);
        const float far = lerp(lerp(corner(0, 0, 1), corner(1, 0, 1), u),
                               lerp(corner(0, 1, 1), corner(1, 1, 1), u), v);
        slab[static_cast<std::size_t>(dw)] = lerp(near, far, s);
    }
    return lerp(slab[0], slab[1], fade(w));
}

float fractal(const Vec3f& p, float time, std::uint32_t seed, int octaves) {
    float sum = 0.0F;
    float height = 0.5F;
    Vec3f q = p;
    for (int i = 0; i < octaves; ++i) {
        sum += height * gradient(q, time, combine(seed, static_cast<std::uint32_t>(i)));
        // A factor a little off two keeps the lattices of the octaves from lining up.
        q *= 2.03F;
        time *= 1.4F;
        height *= 0.5F;
    }
    return sum;
}

Vec3f Worley::feature(int x, int y, int z) const {
    const std::uint32_t h = cell_hash(seed_, x, y, z);
    const std::uint32_t g = mix(h + 0x9e3779b9U);
    const std::uint32_t k = mix(g + 0x9e3779b9U);
    // A small circle about a random home, inside the cell at all times: so a feature less than a
    // cell away is always found in the neighbouring cells.
    const float phase = time_ * lerp(0.1F, 0.22F, unit(k)) + unit(mix(k));
    constexpr float kSwing = 0.16F;
    return {static_cast<float>(x) + lerp(kSwing, 1.0F - kSwing, unit(h)) + kSwing * wave(phase),
            static_cast<float>(y) + lerp(kSwing, 1.0F - kSwing, unit(mix(h))) +
                kSwing * wave(phase + 0.25F),
            static_cast<float>(z) + lerp(kSwing, 1.0F - kSwing, unit(g)) +
                kSwing * wave(phase + unit(mix(g)))};
}

Values Worley::nearest_squared(const Points& points) const {
    const float scale = 1.0F / cell_;
    Points p;
    for (std::size_t i = 0; i < kBatch; ++i) {
        p.x[i] = points.x[i] * scale;
        p.y[i] = points.y[i] * scale;
        p.z[i] = points.z[i] * scale;
    }
    const auto range = [](const Values& v) {
        const auto [low, high] = std::minmax_element(v.begin(), v.end());
        return std::pair{*low, *high};
    };
    const auto [x0, x1] = range(p.x);
    const auto [y0, y1] = range(p.y);
    const auto [z0, z1] = range(p.z);
    const Vec3f centre(0.5F * (x0 + x1), 0.5F * (y0 + y1), 0.5F * (z0 + z1));
    const float radius = 0.5F * Vec3f(x1 - x0, y1 - y0, z1 - z0).length();

    struct Candidate {
        Vec3f position;
        float distance;
    };
    thread_local std::vector<Candidate> candidates;
    candidates.clear();
    float reach = std::numeric_limits<float>::max();
    const auto first = [](float v) { return static_cast<int>(std::floor(v)) - 1; };
    const auto last = [](float v) { return static_cast<int>(std::floor(v)) + 1; };
    for (int x = first(x0); x <= last(x1); ++x) {
        for (int y = first(y0); y <= last(y1); ++y) {
            for (int z = first(z0); z <= last(z1); ++z) {
                const Vec3f f = feature(x, y, z);
                const float distance = (f - centre).length();
                reach = std::min(reach, distance);
                candidates.push_back({f, distance});
            }
        }
    }
    // Only a feature within twice the radius of the nearest one can win for some point, and only
    // one within a cell can win at all: so the answer does not depend on the batch.
    reach = std::min(reach + 2.0F * radius, 1.0F + radius) + 1e-4F;

    Values best;
    best.fill(1.0F);
    for (const Candidate& c : candidates) {
        if (c.distance > reach) continue;
        const float cx = c.position.x();
        const float cy = c.position.y();
        const float cz = c.position.z();
        for (std::size_t i = 0; i < kBatch; ++i) {
            const float dx = cx - p.x[i];
            const float dy = cy - p.y[i];
            const float dz = cz - p.z[i];
            const float d = dx * dx + dy * dy + dz * dz;
            best[i] = d < best[i] ? d : best[i];
        }
    }
    return best;
}

}  // namespace pileus::noise
