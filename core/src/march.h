// Density sampling (Kulla & Fajardo 2012): a ray is marched once, the distribution of
// transmittance-weighted scattering along it is kept, and event distances are drawn by inverting
// it.
#pragma once

#include "medium.h"

#include <algorithm>
#include <cmath>
#include <vector>

namespace pileus {

class DensityMarch {
  public:
    /// Marches the ray in steps of at most one voxel. All steps are read at the same fraction of
    /// their length, `jitter` in [0, 1).
    void march(const Medium& medium, const LocalRay& ray, float jitter) {
        steps_.clear();
        const float speed = std::max(
            {std::abs(ray.direction.x), std::abs(ray.direction.y), std::abs(ray.direction.z)});
        float depth = 0.0f;
        MajorantIterator majorants = medium.majorants(ray);
        MajorantSegment segment;
        while (depth < opaque && majorants.next(segment)) {
            const float length = segment.end - segment.begin;
            const int count = std::max(1, static_cast<int>(std::ceil(length * speed)));
            const float dt = length / static_cast<float>(count);
            for (int i = 0; i < count && depth < opaque; ++i) {
                const float t = segment.begin + static_cast<float>(i) * dt;
                const float sigma = medium.extinction(ray.at(t + jitter * dt));
                if (sigma <= 0.0f) continue;
                const float before = opacity();
                depth += sigma * dt;
                steps_.push_back({t, sigma, before, -std::expm1(-depth)});
            }
        }
    }

    /// 1 - T of the whole ray: the chance that light along it is scattered or absorbed at all.
    float opacity() const { return steps_.empty() ? 0.0f : steps_.back().after; }

    /// The distance at which the share u in [0, 1) of `opacity` is reached. Within a step the
    /// extinction is constant, so the bins weigh (1 - exp(-sigma d)) T, and are inverted exactly.
    float invert(float u) const {
        const float target = u * opacity();
        const auto step =
            std::upper_bound(steps_.begin(), steps_.end() - 1, target,
                             [](float value, const Step& s) { return value < s.after; });
        // T(t) = T(begin) exp(-sigma (t - begin)) = 1 - target
        const float share = (target - step->before) / (1.0f - step->before);
        return step->begin - std::log1p(-std::min(share, 0.999999f)) / step->sigma;
    }

  private:
    struct Step {
        float begin, sigma;
        float before, after;  // opacity from the ray's start to the step's begin and end
    };

    static constexpr float opaque = 16.0f;  // optical depth at which 1 - T is 1 in float

    std::vector<Step> steps_;
};

}  // namespace pileus
