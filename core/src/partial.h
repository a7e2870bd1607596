// What a task renders: the pixels of one bucket over one contiguous range of samples, with all that
// a merge needs to know of them.
#pragma once

#include "exr_file.h"

#include <algorithm>
#include <cstdint>
#include <limits>
#include <string>
#include <vector>

namespace pileus {

/// The sample indices [first, last) of each pixel.
struct SampleRange {
    int first, last;
    int count() const { return last - first; }
    auto operator<=>(const SampleRange&) const = default;
};

/// What a channel holds of a value: no infinity, but the greatest float.
inline float storable(double value) {
    return static_cast<float>(std::min(value, double{std::numeric_limits<float>::max()}));
}

/// The channels of partials and frames: R, G, B, A, Z, the variance of the pixel mean, then the
/// orders.
std::vector<std::string> channel_names(std::size_t orders);

struct Partial {
    enum Channel : std::size_t { r, g, b, a, z, variance_r, variance_g, variance_b, first_order };

    int width = 0, height = 0;  // of the whole image
    SampleRange samples{};
    LayeredImage image;  // means over the samples; of one sample, the variance is told as 0
    std::int64_t bounded_paths = 0;
    // It has had all the samples it may have, and is not within its share of the tolerance.
    bool unmet = false;
    std::string identity;  // of the frame it belongs to: partials of different ones never mix
    // Of `pool_comparing`, by look, R, G, B and pixel; not part of a file.
    std::vector<float> variance_between;

    /// Whole or not at all. The header carries a digest of everything. Throws std::runtime_error.
    void write(const std::string& path) const;

    /// Throws InputError for a file that is truncated, altered or no partial.
    static Partial read(const std::string& path);

    /// The RMS relative error of its pixels for their noise, of the look where it is greatest: the
    /// root of the mean over pixels and RGB of variance / (mean^2 + 0.01), plus one standard error.
    /// The variance is told by each pixel's samples, which know nothing of their stratification,
    /// by how unlike its neighbours a pixel is, which takes detail for noise, and by how far two
    /// ranges of samples lay apart, each less stratified than both: all err upwards, and the least
    /// counts. Infinite for one sample of fewer than 3x3 pixels.
    double relative_error() const;

    /// The mean over pixels of 1 - transmittance.
    double opacity() const;

    /// Adds other samples of the same bucket; variances are pooled (Chan, Golub & LeVeque 1979).
    /// The range then has as many samples as both. Throws as `check_alike` does.
    void pool(const Partial& other);

    /// The same, and keeps what the two differ by, as an estimate of the variance of their mean.
    void pool_comparing(const Partial& other);

    /// Throws InputError for other buckets, looks or orders.
    void check_alike(const Partial& other) const;
};

/// The RMS relative error of two independent halves of a bucket's samples together, once each pixel
/// is the mean over a square of 3x3 to 9x9 pixels about it, whichever serves best; of the look
/// where it is greatest, and `margin` standard errors more. Infinite where there are too few pixels
/// to know. Throws as `check_alike` does.
double smoothed_error(const Partial& half, const Partial& other, double margin);

}  // namespace pileus
