// Tracking: one routine visits a Poisson process of tentative collisions under the local majorants
// (Woodcock et al. 1965; Novak et al. 2018), and serves distance sampling and transmittance alike.
#pragma once

#include "medium.h"

#include <cmath>
#include <optional>

namespace pileus {

/// Calls visit(t, segment, majorant of sigma_t) at each tentative collision along the ray, until it
/// returns true or the ray has left the medium. Collisions come at `rate` times the majorant. The
/// first free flight is given as an optical depth, so that the caller may stratify it. Returns
/// whether a visit ended the ray.
template <class Visit>
bool track(const Medium& medium, const LocalRay& ray, float rate, float first_flight,
           Random& random, Visit&& visit) {
    MajorantIterator majorants = medium.majorants(ray);
    MajorantSegment segment;
    float flight = first_flight;
    while (majorants.next(segment)) {
        const float majorant = medium.majorant(segment.majorant);
        const float frequency = rate * majorant;
        if (frequency == 0.0f) continue;  // without extinction, or with less than a float can hold
        float t = segment.begin;
        for (;;) {
            const float step = flight / frequency;
            if (t + step >= segment.end) {
                flight -= (segment.end - t) * frequency;
                flight = std::max(flight, 0.0f);
                break;
            }
            // Far out on a ray a step may be too short for a float to tell.
            t = t + step > t ? t + step : std::nextafter(t, segment.end);
            if (visit(t, segment, majorant)) return true;
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
    const bool collided = track(medium, ray, 1.0f, first_flight, random,
                                [&](float t, const MajorantSegment& segment, float majorant) {
                                    distance = t;
                                    return random.uniform() * majorant <
                                           medium.extinction_tap(ray.at(t), segment, random);
                                });
    return collided ? std::optional(distance) : std::nullopt;
}

/// A collision that is made to happen: somewhere along the ray, with the weight of the chance that
/// it does.
struct ForcedCollision {
    float chance;  // an unbiased estimate of 1 - T, in [0, 1]; 0 where nothing was met
    float distance;
};

/// Weighted delta tracking (Novak et al. 2018): at each tentative collision a part of the weight
/// collides and the rest goes on. One of the collisions is kept, drawn by its part. Light and
/// opacity where the medium is thin are then no longer a matter of all or nothing. When little is
/// left it goes on as in delta tracking, all of it at once; and a collision of little chance is
/// made a seldom one of more. Collisions come at `rate`, at least 1, times the majorant: the more
/// there are, the less noise.
inline ForcedCollision forced_track(const Medium& medium, const LocalRay& ray, float rate,
                                    float first_flight, Random& random) {
    constexpr float little = 0.1f, seldom = 0.01f;
    ForcedCollision result{0.0f, 0.0f};
    track(medium, ray, rate, first_flight, random,
          [&](float t, const MajorantSegment& segment, float majorant) {
              const float left = 1.0f - result.chance;
              const float part =
                  medium.extinction_tap(ray.at(t), segment, random) / (rate * majorant);
              const bool whole = left < little;
              if (whole && random.uniform() >= part) return false;
              const float collided = whole ? left : left * part;
              result.chance = whole ? 1.0f : result.chance + collided;
              if (random.uniform() * result.chance < collided) result.distance = t;
              return result.chance == 1.0f;
          });
    if (result.chance < seldom)
        result.chance = random.uniform() * seldom < result.chance ? seldom : 0.0f;
    return result;
}

/// Ratio tracking (Novak et al. 2014): an unbiased estimate of T^power, for power in [0, 1]. The
/// power scales the extinction inside the estimator, for E[T^a] is not E[T]^a, and the majorant
/// with it: light that a look lets through easily is also cheap. Collisions come at `rate`, at
/// least 1, times the majorant: the more there are, the less noise. Estimates below a tenth live on
/// with that chance.
inline float ratio_track(const Medium& medium, const LocalRay& ray, float power, float rate,
                         Random& random) {
    constexpr float small = 0.1f;
    if (power == 0.0f) return 1.0f;
    float transmittance = 1.0f;
    track(medium, ray, rate * power, random.exponential(), random,
          [&](float t, const MajorantSegment& segment, float majorant) {
              transmittance *=
                  1.0f - medium.extinction_tap(ray.at(t), segment, random) / (rate * majorant);
              if (transmittance >= small) return false;
              transmittance = random.uniform() * small < transmittance ? small : 0.0f;
              return transmittance == 0.0f;
          });
    return transmittance;
}

}  // namespace pileus
