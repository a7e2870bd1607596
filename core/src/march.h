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
    /// Marches the ray in steps of at most one voxel, or longer ones as long as they are thin. All
    /// are read at the same fraction of their length, `jitter` in [0, 1), but that after long ones
    /// it moves on by the golden ratio with each majorant: they could else keep in step with a
    /// pattern of voxels.
    void march(const Medium& medium, const LocalRay& ray, float jitter) {
        steps_.clear();
        const float speed = std::max(
            {std::abs(ray.direction.x), std::abs(ray.direction.y), std::abs(ray.direction.z)});
        depth_ = 0.0f;
        MajorantIterator majorants = medium.majorants(ray);
        MajorantSegment segment;
        BrickTree::Cursor cursor;
        while (depth_ < opaque && majorants.next(segment)) {
            const float length = segment.end - segment.begin;
            const float dense = medium.majorant(segment.majorant) / thin;
            const bool long_steps = dense < speed;
            const int count =
                std::max(1, static_cast<int>(std::ceil(length * (long_steps ? dense : speed))));
            const float dt = length / static_cast<float>(count);
            for (int i = 0; i < count && depth_ < opaque; ++i) {
                const float t = segment.begin + static_cast<float>(i) * dt;
                const float read = t + jitter * dt;
                const float sigma = medium.extinction(ray.at(read), cursor);
                if (sigma <= 0.0f) continue;
                steps_.push_back({long_steps ? read : t, long_steps ? 0.0f : 1.0f / sigma, depth_});
                depth_ += sigma * dt;
            }
            if (long_steps) jitter += jitter < 1.0f - golden ? golden : golden - 1.0f;
        }
    }

    /// 1 - T of the whole ray: the chance that light along it is scattered or absorbed at all.
    float opacity() const { return depth_ < opaque ? -std::expm1(-depth_) : 1.0f; }

    /// The distance at which the share u in [0, 1) of `opacity` is reached, the extinction being
    /// constant in each step: the bins weigh (1 - exp(-sigma d)) T, and those of a voxel are
    /// inverted exactly. A long one stands where it was read: that it is empty elsewhere moves no
    /// event out of the medium. Only where there is any opacity.
    float invert(float u) const {
        const float depth = -std::log1p(u * std::expm1(-depth_));
        const auto above =
            std::upper_bound(steps_.begin() + 1, steps_.end(), depth,
                             [](float value, const Step& s) { return value < s.depth; });
        const Step& step = *(above - 1);
        return step.begin + (depth - step.depth) * step.mean_free_path;
    }

  private:
    struct Step {
        float begin, mean_free_path;  // of a long step: where it was read, and 0
        float depth;                  // optical depth from the ray's start to the step's begin
    };

    // The march ends here, and the ray counts as opaque: the last e^-8 of the light is spread over
    // what was marched, which shifts one event in 3,000 and loses none.
    static constexpr float opaque = 8.0f;
    // Optical depth of a long step under the majorant: the cost then follows the light, not the
    // voxels.
    static constexpr float thin = 0.3f;
    static constexpr float golden = 0.618034f;

    std::vector<Step> steps_;
    float depth_ = 0.0f;
};

}  // namespace pileus
