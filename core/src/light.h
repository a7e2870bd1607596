// Lights: what a scatter event can ask of a light from far away.
#pragma once

#include "geometry.h"
#include "phase.h"

#include <memory>
#include <optional>
#include <string>
#include <vector>

namespace pileus {

/// A direction towards a light and what comes from there.
struct LightSample {
    V3f direction;   // unit vector towards the light
    Color radiance;  // over the density below, or irradiance where the direction is the only one
    float density;   // per steradian; 0 where the direction is the only one there is
};

/// A light infinitely far away. Implementations are immutable.
class Light {
  public:
    virtual ~Light() = default;

    /// A direction drawn by the light's own importance; nothing if the light offers none (a
    /// constant dome is sampled by the phase function alone).
    virtual std::optional<LightSample> sample(float u1, float u2) const = 0;

    /// The density of `sample`, per steradian.
    virtual float density(const V3f& direction) const = 0;

    /// The radiance that arrives against a direction; what can be hit by a ray and not only be
    /// sampled.
    virtual Color radiance(const V3f& direction) const = 0;

    /// Whether `radiance` can be other than zero.
    virtual bool can_be_hit() const = 0;
};

/// The sun: parallel light, or with an angular diameter (degrees) a disc of constant radiance.
/// `irradiance` falls on a plane that faces it; `direction` is the way the light travels. Not seen
/// by rays.
std::unique_ptr<const Light> make_distant_light(const V3f& direction, const Color& irradiance,
                                                float angle);

/// The sky: constant radiance, times a lat-long texture where one is named (orientation as in
/// OpenEXR's ImfEnvmap.h: +y is up, +z is the middle of the image). Texels that are NaN, infinite
/// or negative are black, and told in `warnings`. Throws InputError for a texture that cannot be
/// read.
std::unique_ptr<const Light> make_dome_light(const Color& radiance, const std::string& texture,
                                             std::vector<std::string>& warnings);

}  // namespace pileus
