#include "frame.h"

#include "error.h"

#include <algorithm>
#include <cmath>

namespace pileus {

namespace {

std::string text(const Bucket& b) {
    return "bucket (" + std::to_string(b.x0) + ", " + std::to_string(b.y0) + ")-(" +
           std::to_string(b.x1) + ", " + std::to_string(b.y1) + ")";
}

std::string text(const SampleRange& range) {
    return "samples [" + std::to_string(range.first) + ", " + std::to_string(range.last) + ")";
}

}  // namespace

Frame::Frame(int width, int height, std::vector<std::pair<Bucket, std::optional<int>>> plan)
    : width_(width), height_(height) {
    std::vector<bool> covered(static_cast<std::size_t>(width) * static_cast<std::size_t>(height));
    for (const auto& [bucket, samples] : plan) {
        if (bucket.x0 < 0 || bucket.y0 < 0 || bucket.x1 > width || bucket.y1 > height ||
            bucket.width() < 1 || bucket.height() < 1 || samples.value_or(1) < 1) {
            throw InputError("the plan's " + text(bucket) + " is empty or lies outside the image");
        }
        for (int y = bucket.y0; y < bucket.y1; ++y) {
            for (int x = bucket.x0; x < bucket.x1; ++x) {
                auto pixel = covered[static_cast<std::size_t>(y) * static_cast<std::size_t>(width) +
                                     static_cast<std::size_t>(x)];
                if (pixel) throw InputError("the plan's " + text(bucket) + " overlaps another");
                pixel = true;
            }
        }
        tiles_.push_back({bucket, samples, 0, {}});
    }
    if (std::find(covered.begin(), covered.end(), false) != covered.end()) {
        throw InputError("the plan's buckets leave pixels uncovered");
    }
}

void Frame::add(const Partial& partial) {
    const Bucket& window = partial.image.window();
    const auto tile = std::find_if(tiles_.begin(), tiles_.end(),
                                   [&](const Tile& t) { return t.bucket == window; });
    if (tile == tiles_.end()) throw InputError(text(window) + " is not in this frame's plan");
    if (partial.width != width_ || partial.height != height_) {
        throw InputError(text(window) + " belongs to an image of another size");
    }
    if (image_.looks().empty()) {
        image_ =
            LayeredImage({0, 0, width_, height_}, partial.image.looks(), partial.image.channels());
        identity_ = partial.identity;
    } else if (partial.identity != identity_ || partial.image.looks() != image_.looks() ||
               partial.image.channels() != image_.channels()) {
        throw InputError(text(window) + ", " + text(partial.samples) +
                         " is of another frame (identity, looks or orders differ)");
    }
    const int reached = tile->reached;
    const int wanted = tile->wanted.value_or(partial.samples.last);
    if (partial.samples.count() < 1 || partial.samples.first != reached ||
        partial.samples.last > wanted) {
        throw InputError(text(window) + ": " + text(partial.samples) + " does not follow the " +
                         std::to_string(reached) + " samples that are there, of " +
                         std::to_string(wanted));
    }
    tile->wanted = wanted;
    tile->reached = partial.samples.last;
    bounded_paths_ += partial.bounded_paths;
    unmet_buckets_ += partial.unmet ? 1 : 0;
    const bool whole = tile->reached == wanted;
    std::vector<Partial>& held = tile->partials;
    held.push_back(partial);
    while (held.size() > 1 &&
           (whole || held.rbegin()[1].samples.count() <= held.back().samples.count())) {
        held.rbegin()[1].pool(held.back());
        held.pop_back();
    }
    if (whole) {
        tile->error = held.front().relative_error();
        place(*tile);
        held.clear();
    }
}

void Frame::place(const Tile& tile) {
    const LayeredImage& source = tile.partials.front().image;
    const Bucket& window = tile.bucket;
    for (std::size_t look = 0; look < source.looks().size(); ++look) {
        for (std::size_t c = 0; c < source.channels().size(); ++c) {
            for (int y = 0; y < window.height(); ++y) {
                std::copy_n(
                    source.plane(look, c) + std::ptrdiff_t{y} * window.width(), window.width(),
                    image_.plane(look, c) + std::ptrdiff_t{window.y0 + y} * width_ + window.x0);
            }
        }
    }
}

double Frame::mean_samples() const {
    double samples = 0.0, pixels = 0.0;
    for (const Tile& tile : tiles_) {
        if (!tile.wanted || tile.reached != tile.wanted) continue;
        const auto area = static_cast<double>(tile.bucket.pixels());
        samples += *tile.wanted * area;
        pixels += area;
    }
    return pixels > 0.0 ? samples / pixels : 0.0;
}

double Frame::relative_error() const {
    double squares = 0.0, pixels = 0.0;
    for (const Tile& tile : tiles_) {
        if (!tile.wanted || tile.reached != tile.wanted) continue;
        const auto area = static_cast<double>(tile.bucket.pixels());
        squares += tile.error * tile.error * area;
        pixels += area;
    }
    return pixels > 0.0 ? std::sqrt(squares / pixels) : 0.0;
}

void Frame::require_complete() const {
    for (const Tile& tile : tiles_) {
        if (!tile.wanted) throw InputError(text(tile.bucket) + " has no samples; render it");
        if (tile.reached == tile.wanted) continue;
        throw InputError(text(tile.bucket) + " has " + std::to_string(tile.reached) + " of its " +
                         std::to_string(*tile.wanted) + " samples; render " +
                         text(SampleRange{tile.reached, *tile.wanted}));
    }
}

void Frame::set_denoised(const std::vector<std::vector<float>>& colors) {
    require_complete();
    const std::size_t pixels = image_.window().pixels(), rendered = image_.channels().size();
    const auto fits = [&](const auto& rgb) { return rgb.size() == 3 * pixels; };
    if (colors.size() != image_.looks().size() ||
        !std::all_of(colors.begin(), colors.end(), fits)) {
        throw InputError("the denoised colours do not fit the image");
    }
    std::vector<std::string> channels = image_.channels();
    for (const char* name : {"noisy.R", "noisy.G", "noisy.B"}) channels.emplace_back(name);
    LayeredImage image(image_.window(), image_.looks(), channels);
    for (std::size_t look = 0; look < colors.size(); ++look) {
        std::copy_n(image_.plane(look, 0), rendered * pixels, image.plane(look, 0));
        std::copy_n(image_.plane(look, Partial::r), 3 * pixels, image.plane(look, rendered));
        for (std::size_t c = 0; c < 3; ++c) {
            float* const plane = image.plane(look, Partial::r + c);
            for (std::size_t i = 0; i < pixels; ++i) plane[i] = colors[look][3 * i + c];
        }
    }
    image_ = std::move(image);
}

void Frame::write(const std::string& path, bool half, const Header& header) const {
    require_complete();
    write_exr(path, image_, width_, height_, half, header);
}

}  // namespace pileus
