// A dome: constant radiance, or a lat-long texture importance sampled by luminance and solid angle.
#include "error.h"
#include "light.h"
#include "texture.h"

#include <algorithm>
#include <cmath>
#include <limits>

namespace pileus {

namespace {

class ConstantDome final : public Light {
  public:
    explicit ConstantDome(const Color& radiance) : radiance_(radiance) {}
    std::optional<LightSample> sample(float, float) const override { return std::nullopt; }
    float density(const V3f&) const override { return 0.0f; }
    Color radiance(const V3f&) const override { return radiance_; }
    bool can_be_hit() const override { return radiance_ != Color(0.0f); }

  private:
    Color radiance_;
};

/// Draws an index with probability proportional to its weight.
class Discrete {
  public:
    explicit Discrete(const std::vector<double>& weights) : cdf_(weights.size() + 1, 0.0) {
        for (std::size_t i = 0; i < weights.size(); ++i) cdf_[i + 1] = cdf_[i] + weights[i];
    }
    double total() const { return cdf_.back(); }
    double weight(std::size_t i) const { return cdf_[i + 1] - cdf_[i]; }

    /// The index, and in `u` what is left of it, again uniform in [0, 1).
    std::size_t sample(double& u) const {
        const double target = u * total();
        const auto above = std::upper_bound(cdf_.begin() + 1, cdf_.end() - 1, target);
        const auto i = static_cast<std::size_t>(above - cdf_.begin()) - 1;
        u = std::clamp((target - cdf_[i]) / weight(i), 0.0, std::nextafter(1.0, 0.0));
        return i;
    }

  private:
    std::vector<double> cdf_;
};

/// The texture is interpolated bilinearly, and sampled by the mean luminance of each texel's
/// square, which is positive wherever the interpolated texture is.
class TexturedDome final : public Light {
  public:
    TexturedDome(std::vector<Color> texels, int width, int height)
        : texels_(std::move(texels)), width_(width), height_(height), rows_({}) {
        std::vector<double> row_weights;
        for (int y = 0; y < height; ++y) {
            const double solid_angle = band(y) * 2.0 * std::numbers::pi / width;
            std::vector<double> weights;
            for (int x = 0; x < width; ++x) {
                importance_.push_back(square_mean(x, y));
                weights.push_back(double{importance_.back()} * solid_angle);
            }
            columns_.emplace_back(weights);
            row_weights.push_back(columns_.back().total());
        }
        rows_ = Discrete(row_weights);
    }

    std::optional<LightSample> sample(float u1, float u2) const override {
        if (rows_.total() <= 0.0) return std::nullopt;
        double v = u1, u = u2;
        const auto y = static_cast<int>(rows_.sample(v));
        const auto x = static_cast<int>(columns_[static_cast<std::size_t>(y)].sample(u));
        // Uniform in the texel's solid angle: in longitude and in the sine of latitude.
        const double longitude = std::numbers::pi * (1.0 - 2.0 * (x + u) / width_);
        const double height = edge(y) - v * band(y);
        const double radius = std::sqrt(std::max(0.0, 1.0 - height * height));
        const V3f direction(static_cast<float>(radius * std::sin(longitude)),
                            static_cast<float>(height),
                            static_cast<float>(radius * std::cos(longitude)));
        const auto density = static_cast<float>(importance_[index(x, y)] / rows_.total());
        return LightSample{direction, radiance(direction) / density, density};
    }

    float density(const V3f& direction) const override {
        if (rows_.total() <= 0.0) return 0.0f;
        const Place place = locate(direction);
        const int x = std::clamp(static_cast<int>(place.x), 0, width_ - 1);
        const int y = std::clamp(static_cast<int>(place.y), 0, height_ - 1);
        return static_cast<float>(importance_[index(x, y)] / rows_.total());
    }

    Color radiance(const V3f& direction) const override {
        const Place place = locate(direction);
        const float fx = place.x - 0.5f, fy = place.y - 0.5f;
        const int x = static_cast<int>(std::floor(fx)), y = static_cast<int>(std::floor(fy));
        const float tx = fx - static_cast<float>(x), ty = fy - static_cast<float>(y);
        const Color top = texel(x, y) * (1.0f - tx) + texel(x + 1, y) * tx;
        const Color bottom = texel(x, y + 1) * (1.0f - tx) + texel(x + 1, y + 1) * tx;
        return top * (1.0f - ty) + bottom * ty;
    }

    bool can_be_hit() const override { return rows_.total() > 0.0; }

  private:
    /// Sine of the latitude of a row's upper edge.
    double edge(int y) const { return std::cos(std::numbers::pi * y / height_); }
    double band(int y) const { return edge(y) - edge(y + 1); }

    std::size_t index(int x, int y) const {
        return static_cast<std::size_t>(y) * static_cast<std::size_t>(width_) +
               static_cast<std::size_t>(x);
    }

    /// Longitude wraps around; the poles do not.
    const Color& texel(int x, int y) const {
        return texels_[index((x + width_) % width_, std::clamp(y, 0, height_ - 1))];
    }

    /// The mean luminance of the interpolated texture over a texel's square: weights 1, 6, 1 in
    /// each axis.
    float square_mean(int x, int y) const {
        float sum = 0.0f;
        for (int dy = -1; dy <= 1; ++dy) {
            for (int dx = -1; dx <= 1; ++dx) {
                sum += (dx == 0 ? 6.0f : 1.0f) * (dy == 0 ? 6.0f : 1.0f) *
                       luminance(texel(x + dx, y + dy));
            }
        }
        return sum / 64.0f;
    }

    struct Place {
        float x, y;  // in texels, from the upper left corner
    };

    Place locate(const V3f& direction) const {
        const float longitude = std::atan2(direction.x, direction.z);
        const float colatitude = std::acos(std::clamp(direction.y, -1.0f, 1.0f));
        return {(0.5f - longitude / (2.0f * pi)) * static_cast<float>(width_),
                colatitude / pi * static_cast<float>(height_)};
    }

    std::vector<Color> texels_;
    std::vector<float> importance_;  // of each texel
    int width_, height_;
    Discrete rows_;
    std::vector<Discrete> columns_;
};

}  // namespace

std::unique_ptr<const Light> make_dome_light(const Color& radiance, const std::string& texture,
                                             std::vector<std::string>& warnings) {
    if (texture.empty()) return std::make_unique<ConstantDome>(radiance);

    const Texture image = read_texture(texture);
    const int channels = image.channels;
    constexpr float most_radiance = 1e12f;  // its square, and sums of it, stay well inside a float
    std::int64_t odd = 0, dimmed = 0;
    std::vector<Color> texels;
    texels.reserve(image.values.size() / static_cast<std::size_t>(channels));
    for (auto value = image.values.begin(); value != image.values.end(); value += channels) {
        Color color =
            radiance * (channels == 3 ? Color(value[0], value[1], value[2]) : Color(value[0]));
        for (int c = 0; c < 3; ++c) {
            if (color[c] > most_radiance && std::isfinite(color[c])) {
                color[c] = most_radiance;
                ++dimmed;
            } else if (!(std::isfinite(color[c]) && color[c] >= 0.0f)) {
                color[c] = 0.0f;
                ++odd;
            }
        }
        texels.push_back(color);
    }
    if (odd > 0) {
        warnings.push_back(texture + ": " + std::to_string(odd) +
                           " values are NaN, infinite or negative; taken as 0");
    }
    if (dimmed > 0) {
        warnings.push_back(texture + ": " + std::to_string(dimmed) +
                           " values are over 1e12; taken as that");
    }
    return std::make_unique<TexturedDome>(std::move(texels), image.width, image.height);
}

}  // namespace pileus
