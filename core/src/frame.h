// The merge: partials put together into a frame, which is written only when nothing is missing.
#pragma once

#include "partial.h"

#include <optional>
#include <string>
#include <utility>
#include <vector>

namespace pileus {

class Frame {
  public:
    /// The buckets and how many samples each must reach; nothing: as many as its one partial has.
    /// Throws InputError unless they tile the image exactly.
    Frame(int width, int height, std::vector<std::pair<Bucket, std::optional<int>>> plan);

    /// Takes the next samples of a bucket; those of one bucket must come in order. Throws
    /// InputError for a partial that is not of the plan, overlaps what is there, leaves a gap, or
    /// is of another frame.
    void add(const Partial& partial);

    /// Puts denoised colours in the place of R, G and B, for each look in turn (RGB, pixel by
    /// pixel); what was rendered stays as noisy.R, noisy.G and noisy.B. Throws InputError where a
    /// bucket lacks samples or the colours do not fit the image.
    void set_denoised(const std::vector<std::vector<float>>& colors);

    /// Writes the whole image. Throws InputError where a bucket lacks samples, std::runtime_error
    /// where the file cannot be written.
    void write(const std::string& path, bool half, const Header& header) const;

    const LayeredImage& image() const { return image_; }

    /// Samples a pixel, over those that have all of theirs.
    double mean_samples() const;

    /// The RMS relative error of all pixels that have all of their samples: see `Partial`.
    double relative_error() const;

    /// Paths that the bound on work has ended, of all partials.
    std::int64_t bounded_paths() const { return bounded_paths_; }

    /// Buckets that have had all the samples they may have, and miss their share of the tolerance.
    int unmet_buckets() const { return unmet_buckets_; }

  private:
    /// What has come of a bucket. Partials are pooled with others of about their size, as each
    /// pooling rounds to a float: one after the other, hundreds would drift, and late ones hardly
    /// count.
    struct Tile {
        Bucket bucket;
        std::optional<int> wanted;
        int reached = 0;                // samples
        std::vector<Partial> partials;  // in order, each of more samples than the next
        double error = 0.0;             // of all of them
    };

    void require_complete() const;
    void place(const Tile& tile);

    int width_, height_;
    std::vector<Tile> tiles_;
    std::string identity_;
    LayeredImage image_;
    std::int64_t bounded_paths_ = 0;
    int unmet_buckets_ = 0;
};

}  // namespace pileus
