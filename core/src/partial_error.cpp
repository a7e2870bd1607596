// How far a partial's pixels are from what more samples would make of them.
#include "block_mean.h"
#include "partial.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <vector>

namespace pileus {

namespace {

/// The side of the blocks that are looked at. A pixel that has missed its rare bright paths has too
/// small a variance, and one that has met them too large a mean: pixel by pixel the ratio would be
/// too small. Blocks even that out, but take the noise of bright pixels for that of the dark ones
/// beside them, too: where pixels have many samples, smaller blocks hold enough.
int block_of(const SampleRange& samples) { return samples.count() < 16 ? 4 : 2; }

constexpr double margin = 1.0;  // standard errors

/// Squares of pixels of a bucket, by rows; those at the far edges are smaller.
struct Blocks {
    Blocks(const Bucket& window, int side)
        : width(window.width()),
          height(window.height()),
          block(side),
          columns((width + side - 1) / side),
          rows((height + side - 1) / side) {}

    /// The means over blocks of what `of` tells of the pixels (x, y) from `inset` pixels off the
    /// edges on. Where a block has none of these: NaN.
    template <typename Of>
    std::vector<double> means(int inset, const Of& of) const {
        const auto blocks = static_cast<std::size_t>(columns) * static_cast<std::size_t>(rows);
        std::vector<double> sums(blocks, 0.0), counts(blocks, 0.0);
        for (int y = inset; y < height - inset; ++y) {
            for (int x = inset; x < width - inset; ++x) {
                const auto i = static_cast<std::size_t>(y / block * columns + x / block);
                sums[i] += of(x, y);
                counts[i] += 1.0;
            }
        }
        for (std::size_t i = 0; i < blocks; ++i) sums[i] /= counts[i];
        return sums;
    }

    std::vector<double> means(const float* plane) const {
        return means(0, [&](int x, int y) { return double{plane[y * width + x]}; });
    }

    /// What noise that is independent from pixel to pixel leaves of a 3x3 neighbourhood from which
    /// all that is linear along rows or columns has been taken; scaled so that its mean is the
    /// variance (Immerkaer 1996).
    std::vector<double> ripples(const float* plane) const {
        return means(1, [&](int x, int y) {
            const auto bend = [&](int row) {
                const float* const p = plane + row * width + x;
                return double{p[-1]} - 2.0 * double{p[0]} + double{p[1]};
            };
            const double sum = bend(y - 1) - 2.0 * bend(y) + bend(y + 1);
            return sum * sum / 36.0;
        });
    }

    int width, height, block, columns, rows;
};

using Channels = std::array<std::vector<double>, 3>;  // by block

/// The mean over blocks of a quantity relative to the image. The channels of a block are one, for
/// they see the same paths.
BlockMean relative(const Channels& levels, const Channels& quantity) {
    BlockMean mean;
    for (std::size_t i = 0; i < levels[0].size(); ++i) {
        double sum = 0.0;
        for (std::size_t c = 0; c < 3; ++c)
            sum += quantity[c][i] / (levels[c][i] * levels[c][i] + 0.01);
        if (!std::isnan(sum)) mean.add(sum / 3.0);
    }
    return mean;
}

}  // namespace

double Partial::relative_error() const {
    const Blocks blocks(image.window(), block_of(samples));
    const std::size_t pixels = image.window().pixels();
    double greatest = 0.0;
    for (std::size_t look = 0; look < image.looks().size(); ++look) {
        Channels levels, ripples, variances, ranges;
        for (std::size_t c = 0; c < 3; ++c) {
            levels[c] = blocks.means(image.plane(look, r + c));
            ripples[c] = blocks.ripples(image.plane(look, r + c));
            if (samples.count() > 1) variances[c] = blocks.means(image.plane(look, variance_r + c));
            if (!variance_between.empty())
                ranges[c] = blocks.means(variance_between.data() + (look * 3 + c) * pixels);
        }
        double least = relative(levels, ripples).upper(margin);
        if (samples.count() > 1) least = std::min(least, relative(levels, variances).upper(margin));
        if (!variance_between.empty())
            least = std::min(least, relative(levels, ranges).upper(margin));
        greatest = std::max(greatest, least);
    }
    return std::sqrt(greatest);
}

}  // namespace pileus
