// Tracking: one routine visits a Poisson process of tentative collisions under the local majorants
// (Woodcock et al. 1965; Novak et al. 2018), and serves distance sampling and transmittance alike.
#pragma once

#include "medium.h"

#include <optional>
#include <span>

namespace pileus {

/// Calls visit(t, majorant) at each tentative collision along the ray, until it returns true or the
/// ray has left the medium. The first free flight is given as an optical depth, so that the caller
/// may stratify it. Returns whether a visit ended the ray.
template <class Visit>
bool track(const Medium& medium, const LocalRay& ray, float first_flight, Random& random,
           Visit&& visit) {
    MajorantIterator majorants = medium.majorants(ray);
    MajorantSegment segment;
    float flight = first_flight;
    while (majorants.next(segment)) {
        const float majorant = segment.majorant * medium.scale();
        float t = segment.begin;
        for (;;) {
            const float step = flight / majorant;
            if (t + step >= segment.end) {
                flight -= (segment.end - t) * majorant;
                flight = std::max(flight, 0.0f);
                break;
            }
            t += step;
            if (visit(t, majorant)) return true;
            flight = random.exponential();
        }
    }
    return false;
}

/// Delta tracking: the distance to the next true collision, distributed as transmittance times
/// extinction; nothing where the ray leaves the medium.
inline std::optional<float> delta_track(const Medium& medium, const LocalRay& ray,
                                        float first_flight, Random& random) {
    float distance = 0.0f;
    const bool collided = track(medium, ray, first_flight, random, [&](float t, float majorant) {
        distance = t;
        return random.uniform() * majorant < medium.extinction_tap(ray.at(t), random);
    });
    return collided ? std::optional(distance) : std::nullopt;
}

/// Ratio tracking (Novak et al. 2014) of several powers at once: afterwards transmittances[k]
/// estimates T^powers[k] without bias, all from one walk along the ray; powers lie in [0, 1]. The
/// power scales the extinction inside the estimator, for E[T^a] is not E[T]^a. Estimates below a
/// tenth live on with that chance, each by the same random numbers whatever the others do.
inline void ratio_track(const Medium& medium, const LocalRay& ray, Random& random,
                        std::span<const float> powers, std::span<float> transmittances) {
    constexpr float small = 0.1f;
    std::fill(transmittances.begin(), transmittances.end(), 1.0f);
    track(medium, ray, random.exponential(), random, [&](float t, float majorant) {
        const float ratio = medium.extinction_tap(ray.at(t), random) / majorant;
        const float chance = random.uniform() * small;
        bool alive = false;
        for (std::size_t k = 0; k < powers.size(); ++k) {
            float& estimate = transmittances[k];
            estimate *= 1.0f - powers[k] * ratio;
            if (estimate < small) estimate = chance < estimate ? small : 0.0f;
            alive |= estimate > 0.0f;
        }
        return !alive;
    });
}

}  // namespace pileus
