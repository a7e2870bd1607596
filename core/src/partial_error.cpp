// How far a partial's pixels are from what more samples would make of them.
#include "block_mean.h"
#include "partial.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <optional>

namespace pileus {

namespace {

// A pixel that has missed its rare bright paths has too small a variance, and one that has met them
// too large a mean: pixel by pixel the ratio would be too small. Blocks even that out.
constexpr int block = 4;

/// One channel of a bucket.
struct Pixels {
    Pixels(const float* plane, const Bucket& window)
        : values(plane), width(window.width()), height(window.height()) {}

    std::optional<double> at(int x, int y) const { return values[y * width + x]; }

    /// What noise that is independent from pixel to pixel leaves of a 3x3 neighbourhood from which
    /// all that is linear along rows or columns has been taken; scaled so that its mean is the
    /// variance (Immerkaer 1996).
    std::optional<double> ripple(int x, int y) const {
        if (x < 1 || y < 1 || x + 1 >= width || y + 1 >= height) return std::nullopt;
        constexpr std::array kernel{1.0, -2.0, 1.0};
        double sum = 0.0;
        for (int j = 0; j < 3; ++j) {
            for (int i = 0; i < 3; ++i) {
                sum += kernel[static_cast<std::size_t>(i)] * kernel[static_cast<std::size_t>(j)] *
                       values[(y + j - 1) * width + x + i - 1];
            }
        }
        return sum * sum / 36.0;
    }

    /// The mean over those of a block's pixels where there is one.
    std::optional<double> over_block(int x0, int y0,
                                     std::optional<double> (Pixels::*of)(int, int) const) const {
        double sum = 0.0;
        int count = 0;
        for (int y = y0; y < std::min(y0 + block, height); ++y) {
            for (int x = x0; x < std::min(x0 + block, width); ++x) {
                if (const auto value = (this->*of)(x, y)) {
                    sum += *value;
                    ++count;
                }
            }
        }
        return count > 0 ? std::optional(sum / count) : std::nullopt;
    }

    const float* values;
    int width, height;
};

}  // namespace

double Partial::relative_error() const {
    double greatest = 0.0;
    for (std::size_t look = 0; look < image.looks().size(); ++look) {
        BlockMean by_samples, by_neighbours, by_ranges;
        for (std::size_t c = 0; c < 3; ++c) {
            const Pixels mean{image.plane(look, r + c), image.window()};
            const Pixels variance{image.plane(look, variance_r + c), image.window()};
            for (int y = 0; y < mean.height; y += block) {
                for (int x = 0; x < mean.width; x += block) {
                    const double level = mean.over_block(x, y, &Pixels::at).value_or(0.0);
                    const double scale = 1.0 / (level * level + 0.01);
                    if (samples.count() > 1)
                        by_samples.add(scale * *variance.over_block(x, y, &Pixels::at));
                    if (const auto ripple = mean.over_block(x, y, &Pixels::ripple))
                        by_neighbours.add(scale * *ripple);
                    if (!apart.empty()) {
                        const Pixels ranges{apart.data() + (look * 3 + c) * image.window().pixels(),
                                            image.window()};
                        by_ranges.add(scale * *ranges.over_block(x, y, &Pixels::at));
                    }
                }
            }
        }
        greatest = std::max(
            greatest, std::min({by_samples.upper(), by_neighbours.upper(), by_ranges.upper()}));
    }
    return std::sqrt(greatest);
}

}  // namespace pileus
