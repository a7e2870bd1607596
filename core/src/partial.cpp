#include "partial.h"

#include "error.h"
#include "random.h"

#include <algorithm>
#include <bit>
#include <cstdio>
#include <numeric>

namespace pileus {

namespace {

constexpr const char* format_version = "1";

/// A 64-bit digest of all that a partial says.
std::string digest(const Partial& partial) {
    std::uint64_t hash = 0;
    const auto fold_text = [&](const std::string& text) {
        hash = hash_key(hash, text.size());
        for (const char c : text) hash = hash_key(hash, static_cast<unsigned char>(c));
    };
    const Bucket& w = partial.image.window();
    for (const int number : {partial.width, partial.height, w.x0, w.y0, w.x1, w.y1,
                             partial.samples.first, partial.samples.last}) {
        hash = hash_key(hash, static_cast<std::uint64_t>(number));
    }
    hash = hash_key(hash, static_cast<std::uint64_t>(partial.bounded_paths));
    if (partial.unmet) hash = hash_key(hash, 1);
    fold_text(partial.identity);
    for (const auto& look : partial.image.looks()) fold_text(look);
    for (const float value : partial.image.data())
        hash = mix64(hash + std::bit_cast<std::uint32_t>(value));
    char text[17];
    std::snprintf(text, sizeof text, "%016llx", static_cast<unsigned long long>(hash));
    return text;
}

/// OpenEXR keeps channels sorted by name; partials keep them in the order of `channel_names`.
LayeredImage reorder(const LayeredImage& sorted, const std::vector<std::string>& channels) {
    LayeredImage image(sorted.window(), sorted.looks(), channels);
    for (std::size_t c = 0; c < channels.size(); ++c) {
        const auto found =
            std::find(sorted.channels().begin(), sorted.channels().end(), channels[c]);
        if (found == sorted.channels().end()) throw InputError("lacks channel " + channels[c]);
        const auto from = static_cast<std::size_t>(found - sorted.channels().begin());
        for (std::size_t look = 0; look < image.looks().size(); ++look) {
            std::copy_n(sorted.plane(look, from), image.window().pixels(), image.plane(look, c));
        }
    }
    return image;
}

}  // namespace

std::vector<std::string> channel_names(std::size_t orders) {
    std::vector<std::string> names{"R", "G",          "B",          "A",
                                   "Z", "variance.R", "variance.G", "variance.B"};
    for (std::size_t i = 0; i < orders; ++i) {
        const std::string order = (i < 10 ? "order0" : "order") + std::to_string(i);
        for (const char* c : {".R", ".G", ".B"}) names.push_back(order + c);
    }
    return names;
}

void Partial::write(const std::string& path) const {
    Header header{
        {"pileusPartial", std::string(format_version)},
        {"pileusIdentity", identity},
        {"pileusSamples", std::to_string(samples.first) + " " + std::to_string(samples.last)},
        {"pileusBoundedPaths", std::to_string(bounded_paths)},
        {"pileusDigest", digest(*this)},
    };
    if (unmet) header.emplace("pileusUnmet", std::string("1"));
    write_exr(path, image, width, height, false, header);
}

Partial Partial::read(const std::string& path) {
    ExrFile file = read_exr(path);
    const auto text = [&](const char* name) -> const std::string& {
        const auto found = file.text.find(name);
        if (found == file.text.end())
            throw InputError(path + ": is not a partial (no " + name + " in its header)");
        return found->second;
    };
    if (text("pileusPartial") != format_version) {
        throw InputError(path + ": is a partial of format " + text("pileusPartial") +
                         ", and this is format " + format_version);
    }
    Partial partial;
    partial.width = file.width;
    partial.height = file.height;
    partial.identity = text("pileusIdentity");
    long long bounded = 0;
    if (std::sscanf(text("pileusSamples").c_str(), "%d %d", &partial.samples.first,
                    &partial.samples.last) != 2 ||
        std::sscanf(text("pileusBoundedPaths").c_str(), "%lld", &bounded) != 1) {
        throw InputError(path + ": its header is damaged; render it again");
    }
    partial.bounded_paths = bounded;
    partial.unmet = file.text.contains("pileusUnmet");
    const std::size_t all = file.image.channels().size(), fixed = Partial::first_order;
    if (all < fixed || (all - fixed) % 3 != 0)
        throw InputError(path + ": has not the channels of a partial");
    try {
        partial.image = reorder(file.image, channel_names((all - fixed) / 3));
    } catch (const InputError& error) {
        throw InputError(path + ": " + error.what());
    }
    if (digest(partial) != text("pileusDigest")) {
        throw InputError(path + ": its pixels are not those that were written; render it again");
    }
    return partial;
}

double Partial::opacity() const {
    const float* const alpha = image.plane(0, a);
    const std::size_t pixels = image.window().pixels();
    return std::accumulate(alpha, alpha + pixels, 0.0) / static_cast<double>(pixels);
}

void Partial::check_alike(const Partial& other) const {
    if (other.image.window() != image.window() || other.image.looks() != image.looks() ||
        other.image.channels() != image.channels()) {
        throw InputError("the partials are of different buckets, looks or orders");
    }
}

void Partial::pool_comparing(const Partial& other) {
    check_alike(other);
    const double n1 = samples.count(), n2 = other.samples.count(), n = n1 + n2;
    const std::size_t pixels = image.window().pixels();
    variance_between.resize(image.looks().size() * 3 * pixels);
    for (std::size_t look = 0; look < image.looks().size(); ++look) {
        for (std::size_t c = 0; c < 3; ++c) {
            const float* const mine = image.plane(look, r + c);
            const float* const theirs = other.image.plane(look, r + c);
            float* const into = variance_between.data() + (look * 3 + c) * pixels;
            for (std::size_t pixel = 0; pixel < pixels; ++pixel) {
                const double gap = double{theirs[pixel]} - mine[pixel];
                into[pixel] = storable(gap * gap * n1 * n2 / (n * n));
            }
        }
    }
    pool(other);
}

void Partial::pool(const Partial& other) {
    check_alike(other);
    const double n1 = samples.count(), n2 = other.samples.count(), n = n1 + n2;
    const std::size_t pixels = image.window().pixels();
    for (std::size_t look = 0; look < image.looks().size(); ++look) {
        const auto mine = [&](std::size_t c) { return image.plane(look, c); };
        const auto theirs = [&](std::size_t c) { return other.image.plane(look, c); };
        for (std::size_t pixel = 0; pixel < pixels; ++pixel) {
            const auto mean = [&](std::size_t c) {
                mine(c)[pixel] =
                    static_cast<float>((n1 * mine(c)[pixel] + n2 * theirs(c)[pixel]) / n);
            };
            // The depth is a mean over the rays that met something.
            const double w1 = n1 * mine(a)[pixel], w2 = n2 * theirs(a)[pixel];
            if (w1 + w2 > 0.0) {
                mine(z)[pixel] =
                    static_cast<float>((w1 * mine(z)[pixel] + w2 * theirs(z)[pixel]) / (w1 + w2));
            }
            for (std::size_t c = 0; c < 3; ++c) {
                const double gap = double{theirs(r + c)[pixel]} - mine(r + c)[pixel];
                const double squares = mine(variance_r + c)[pixel] * n1 * (n1 - 1.0) +
                                       theirs(variance_r + c)[pixel] * n2 * (n2 - 1.0) +
                                       gap * gap * n1 * n2 / n;
                mine(variance_r + c)[pixel] = storable(squares / (n * (n - 1.0)));
            }
            for (std::size_t c = r; c <= a; ++c) mean(c);
            for (std::size_t c = first_order; c < image.channels().size(); ++c) mean(c);
        }
    }
    const int first = std::min(samples.first, other.samples.first);
    samples = {first, first + samples.count() + other.samples.count()};
    bounded_paths += other.bounded_paths;
}

}  // namespace pileus
