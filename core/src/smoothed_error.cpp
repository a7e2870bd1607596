// How far a bucket is from the truth when it is smoothed: what a denoiser, of which no less may be
// expected, can be trusted with.
#include "block_mean.h"
#include "partial.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <vector>

namespace pileus {

namespace {

using Means = std::vector<double>;  // by pixel

/// The sums over all that lies above and to the left of each pixel's corners, of a plane.
class SummedArea {
  public:
    SummedArea(const float* plane, const Bucket& window)
        : width_(window.width()), height_(window.height()), sums_(at(0, height_ + 1), 0.0) {
        for (int y = 0; y < height_; ++y) {
            double row = 0.0;
            for (int x = 0; x < width_; ++x) {
                row += double{plane[y * width_ + x]};
                sums_[at(x + 1, y + 1)] = sums_[at(x + 1, y)] + row;
            }
        }
    }

    /// Means over the squares of 2 r + 1 pixels' side about each pixel, cut off at the edges.
    Means means(int r) const {
        Means means;
        means.reserve(static_cast<std::size_t>(width_) * static_cast<std::size_t>(height_));
        for (int y = 0; y < height_; ++y) {
            const int y0 = std::max(0, y - r), y1 = std::min(height_, y + r + 1);
            const double* const above = &sums_[at(0, y0)];
            const double* const below = &sums_[at(0, y1)];
            for (int x = 0; x < width_; ++x) {
                const int x0 = std::max(0, x - r), x1 = std::min(width_, x + r + 1);
                const double sum = below[x1] - above[x1] - below[x0] + above[x0];
                means.push_back(sum / ((x1 - x0) * (y1 - y0)));
            }
        }
        return means;
    }

  private:
    std::size_t at(int x, int y) const { return static_cast<std::size_t>(y * (width_ + 1) + x); }

    int width_, height_;
    std::vector<double> sums_;
};

constexpr int largest = 4;  // radius of a square

/// One channel of two independent halves of a bucket's samples, A and B, smoothed over squares, by
/// radius; those of radius 0 are the pixels.
struct Smoothed {
    Smoothed(const float* half, const float* other, const Bucket& window) {
        const SummedArea of_half(half, window), of_other(other, window);
        for (int r = 0; r <= largest; ++r) {
            a.push_back(of_half.means(r));
            b.push_back(of_other.means(r));
        }
    }

    /// Of the mean of both halves, an estimate of the variance that squares leave.
    double variance(std::size_t r, std::size_t pixel) const {
        const double apart = a[r][pixel] - b[r][pixel];
        return apart * apart / 4.0;
    }

    /// An estimate of the squared bias of squares: of what they differ by from the next smaller
    /// ones, of the other half so that noise does not meet itself. (The pixels of the smaller ones
    /// are also in the larger, which takes twice their variance off again.) Where an image is
    /// curved the bias of a mean grows as the variance of its square's pixels, side^2 - 1, and so
    /// it is in proportion to that difference.
    double squared_bias(std::size_t r, std::size_t pixel) const {
        if (r == 0) return 0.0;  // a pixel itself has none
        const auto spread = [](std::size_t radius) {
            const double side = 2.0 * static_cast<double>(radius) + 1.0;
            return side * side - 1.0;
        };
        const double curvature = spread(r) / (spread(r) - spread(r - 1));
        const double apart = a[r][pixel] - b[r][pixel];
        const double shift = (a[r][pixel] - b[r - 1][pixel]) * (b[r][pixel] - a[r - 1][pixel]);
        return curvature * curvature * (shift + apart * apart);
    }

    double level(std::size_t pixel) const { return (a[1][pixel] + b[1][pixel]) / 2.0; }

    std::vector<Means> a, b;
};

constexpr int block = 8;  // what smoothing leaves of noise is alike from pixel to pixel
constexpr int fewest_blocks = 8;

/// What squares of a radius leave, relative to the image: means over whole blocks and channels.
struct Left {
    Left(const std::array<Smoothed, 3>& channels, const Bucket& window, std::size_t r) {
        for (int y0 = 0; y0 + block <= window.height(); y0 += block) {
            for (int x0 = 0; x0 + block <= window.width(); x0 += block)
                add(channels, window, r, x0, y0);
        }
    }

    void add(const std::array<Smoothed, 3>& channels, const Bucket& window, std::size_t r, int x0,
             int y0) {
        double block_variance = 0.0, block_bias = 0.0;
        for (const Smoothed& channel : channels) {
            double level = 0.0, variances = 0.0, biases = 0.0;
            for (int y = y0; y < y0 + block; ++y) {
                for (int x = x0; x < x0 + block; ++x) {
                    const auto pixel = static_cast<std::size_t>(y * window.width() + x);
                    level += channel.level(pixel) / (block * block);
                    variances += channel.variance(r, pixel) / (block * block);
                    biases += channel.squared_bias(r, pixel) / (block * block);
                }
            }
            const double scale = 1.0 / (level * level + 0.01) / 3.0;
            block_variance += scale * variances;
            block_bias += scale * biases;
        }
        variance.add(block_variance);
        squared_bias.add(block_bias);
        squared_error.add(block_variance + block_bias);
    }

    BlockMean variance, squared_bias, squared_error;
};

}  // namespace

double smoothed_error(const Partial& half, const Partial& other, double margin) {
    half.check_alike(other);
    const Bucket& window = half.image.window();
    if ((window.width() / block) * (window.height() / block) < fewest_blocks)
        return std::numeric_limits<double>::infinity();
    double greatest = 0.0;
    for (std::size_t look = 0; look < half.image.looks().size(); ++look) {
        const auto smoothed = [&](std::size_t channel) {
            return Smoothed(half.image.plane(look, channel), other.image.plane(look, channel),
                            window);
        };
        const std::array channels{smoothed(Partial::r), smoothed(Partial::g), smoothed(Partial::b)};
        const Left finest(channels, window, 1);
        double least = finest.squared_error.upper(margin);
        for (std::size_t r = 2; r <= largest; ++r) {
            const Left left(channels, window, r);
            // Detail as fine as pixels is lost on the larger squares and the next smaller ones
            // alike.
            least = std::min(least, std::max(left.squared_error.upper(margin),
                                             left.variance.mean() + finest.squared_bias.mean()));
        }
        // Few blocks may seem free of error by chance, but no square leaves less than the mean of
        // its pixels does of their noise.
        constexpr double most_pixels = (2 * largest + 1) * (2 * largest + 1);
        const Left pixels(channels, window, 0);
        greatest = std::max({greatest, least, pixels.variance.mean() / most_pixels});
    }
    return std::sqrt(greatest);
}

}  // namespace pileus
