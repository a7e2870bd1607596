// A distant light: the one direction of a parallel beam, or a cone of directions about it.
#include "light.h"

namespace pileus {

namespace {

class DistantLight final : public Light {
  public:
    DistantLight(const V3f& direction, const Color& irradiance, float angle)
        : towards_(-direction.normalized()) {
        constexpr float least_angle = 1e-5f;  // no float direction can tell a lesser one from none
        if (angle < least_angle) {
            radiance_ = irradiance;
            return;
        }
        const double half = 0.5 * angle * std::numbers::pi / 180.0;
        const double sine = std::sin(0.5 * half);
        one_minus_cos_ = static_cast<float>(2.0 * sine * sine);
        // A disc of radiance L and half angle h gives a plane that faces it L pi sin^2 h.
        density_ = 1.0f / (2.0f * pi * one_minus_cos_);
        radiance_ =
            irradiance / static_cast<float>(std::numbers::pi * std::sin(half) * std::sin(half));
    }

    std::optional<LightSample> sample(float u1, float u2) const override {
        if (density_ == 0.0f) return LightSample{towards_, radiance_, 0.0f};
        const V3f direction = turned_to(towards_, from_pole(u1 * one_minus_cos_, u2));
        return LightSample{direction, radiance_ / density_, density_};
    }

    float density(const V3f&) const override { return 0.0f; }
    Color radiance(const V3f&) const override { return Color(0.0f); }
    bool can_be_hit() const override { return false; }

  private:
    V3f towards_;
    Color radiance_;
    float one_minus_cos_ = 0.0f;
    float density_ = 0.0f;
};

}  // namespace

std::unique_ptr<const Light> make_distant_light(const V3f& direction, const Color& irradiance,
                                                float angle) {
    return std::make_unique<DistantLight>(direction, irradiance, angle);
}

}  // namespace pileus
