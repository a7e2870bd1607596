// How far a partial's pixels are from what more samples would make of them.
#include "block_mean.h"
#include "partial.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <optional>

namespace pileus {

namespace {

/// The side of the blocks that are looked at. A pixel that has missed its rare bright paths has too
/// small a variance, and one that has met them too large a mean: pixel by pixel the ratio would be
/// too small. Blocks even that out, but take the noise of bright pixels for that of the dark ones
/// beside them, too: where pixels have many samples, smaller blocks hold enough.
int block_of(const SampleRange& samples) { return samples.count() < 16 ? 4 : 2; }

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
    std::optional<double> over_block(int x0, int y0, int block,
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

constexpr double margin = 1.0;  // standard errors

using Channels = std::array<Pixels, 3>;

/// The mean over blocks of a quantity relative to the image. The channels of a block are one, for
/// they see the same paths.
BlockMean relative(const Channels& image, const Channels& quantity, int block,
                   std::optional<double> (Pixels::*of)(int, int) const) {
    BlockMean mean;
    for (int y = 0; y < image[0].height; y += block) {
        for (int x = 0; x < image[0].width; x += block) {
            double sum = 0.0;
            int channels = 0;
            for (std::size_t c = 0; c < 3; ++c) {
                const double level = image[c].over_block(x, y, block, &Pixels::at).value_or(0.0);
                if (const auto value = quantity[c].over_block(x, y, block, of)) {
                    sum += *value / (level * level + 0.01);
                    ++channels;
                }
            }
            if (channels > 0) mean.add(sum / channels);
        }
    }
    return mean;
}

}  // namespace

double Partial::relative_error() const {
    const int block = block_of(samples);
    const std::size_t pixels = image.window().pixels();
    double greatest = 0.0;
    for (std::size_t look = 0; look < image.looks().size(); ++look) {
        const auto channels = [&](const float* first) {
            return Channels{Pixels{first, image.window()}, Pixels{first + pixels, image.window()},
                            Pixels{first + 2 * pixels, image.window()}};
        };
        const Channels means = channels(image.plane(look, r));
        const Channels variances = channels(image.plane(look, variance_r));
        double least = relative(means, means, block, &Pixels::ripple).upper(margin);
        if (samples.count() > 1)
            least = std::min(least, relative(means, variances, block, &Pixels::at).upper(margin));
        if (!apart.empty()) {
            const Channels ranges = channels(apart.data() + look * 3 * pixels);
            least = std::min(least, relative(means, ranges, block, &Pixels::at).upper(margin));
        }
        greatest = std::max(greatest, least);
    }
    return std::sqrt(greatest);
}

}  // namespace pileus
