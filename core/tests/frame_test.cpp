// Partials on disk and their merge: what is damaged, missing, doubled or foreign is refused, and
// pooled statistics are those of one range.
#include "frame.h"

#include "error.h"
#include "support.h"

#include <cmath>
#include <fstream>
#include <functional>
#include <gtest/gtest.h>
#include <sstream>

namespace pileus {
namespace {

constexpr int width = 24, height = 12;

/// A partial whose pixels are given by a function of look, channel, x and y.
Partial make_partial(const Bucket& bucket, const SampleRange& samples, const std::string& identity,
                     std::vector<std::string> looks = {"hero", "fill"}, std::size_t orders = 0) {
    Partial partial;
    partial.width = width;
    partial.height = height;
    partial.samples = samples;
    partial.identity = identity;
    partial.bounded_paths = 3;
    partial.image = LayeredImage(bucket, std::move(looks), channel_names(orders));
    Random random(hash_key(std::uint64_t(bucket.x0), std::uint64_t(samples.first)));
    for (std::size_t l = 0; l < partial.image.looks().size(); ++l) {
        for (std::size_t c = 0; c < partial.image.channels().size(); ++c) {
            for (std::size_t i = 0; i < bucket.pixels(); ++i) {
                partial.image.plane(l, c)[i] = random.uniform();
            }
        }
    }
    return partial;
}

const Bucket left{0, 0, 16, 12}, right{16, 0, 24, 12};
const std::vector<std::pair<Bucket, std::optional<int>>> plan{{left, 16}, {right, 8}};

std::string refusal(const std::function<void()>& action) {
    try {
        action();
    } catch (const InputError& error) {
        EXPECT_EQ(std::string(error.what()).find('\n'), std::string::npos);
        return error.what();
    }
    return "";
}

/// A bucket of one look whose every pixel is `level` and noise of so much variance, which its
/// samples take for `told`; `detail` is added to and taken from the pixels by turns.
Partial noisy(double level, double variance, double told, double detail = 0.0,
              std::uint64_t seed = 7) {
    Partial partial = make_partial({0, 0, width, height}, {0, 4}, "shot", {"beauty"});
    Random random(seed);
    for (std::size_t c = 0; c < 3; ++c) {
        for (std::size_t i = 0; i < partial.image.window().pixels(); ++i) {
            // Uniform, of variance 1.
            const double noise = std::sqrt(12.0) * (double{random.uniform()} - 0.5);
            const double sign = (i % width + i / width) % 2 == 0 ? 1.0 : -1.0;
            partial.image.plane(0, Partial::r + c)[i] =
                static_cast<float>(level + sign * detail + std::sqrt(variance) * noise);
            partial.image.plane(0, Partial::variance_r + c)[i] = static_cast<float>(told);
        }
    }
    return partial;
}

TEST(Partial, TellsItsErrorBySamplesNeighboursOrRangesWhicheverSaysLeast) {
    const double level = 2.0, variance = 0.01;
    const double exact = std::sqrt(variance / (level * level + 0.01));
    // Samples that know nothing of their stratification say too much, and so does detail. One
    // standard error, here of 54 blocks, comes on top.
    EXPECT_NEAR(noisy(level, variance, variance).relative_error(), exact, 0.05 * exact);
    EXPECT_NEAR(noisy(level, variance, 9 * variance).relative_error(), exact, 0.15 * exact);
    EXPECT_NEAR(noisy(level, variance, variance, 0.5).relative_error(), exact, 0.05 * exact);
    EXPECT_GT(noisy(level, variance, 9 * variance, 0.5).relative_error(), 2 * exact);
    // Detail is common to two ranges, and what they differ by knows of their stratification.
    Partial pooled = noisy(level, 2 * variance, 18 * variance, 0.5);
    pooled.pool_comparing(noisy(level, 2 * variance, 18 * variance, 0.5, 8));
    EXPECT_NEAR(pooled.relative_error(), exact, 0.15 * exact);
}

TEST(Partial, OfManySamplesTellsBrightPixelsFromTheDarkOnesBesideThem) {
    // Squares of 2x2 pixels by turns: bright ones with noise, dark ones without.
    Partial partial = noisy(0.1, 0.0, 0.0);
    for (int y = 0; y < height; ++y) {
        for (int x = 0; x < width; ++x) {
            if ((x / 2 + y / 2) % 2 != 0) continue;
            for (std::size_t c = 0; c < 3; ++c) {
                partial.image.plane(0, Partial::r + c)[y * width + x] = 2.0F;
                partial.image.plane(0, Partial::variance_r + c)[y * width + x] = 0.01F;
            }
        }
    }
    const double exact = std::sqrt(0.01 / 4.01 / 2.0);
    partial.samples = {0, 64};
    EXPECT_NEAR(partial.relative_error(), exact, 0.06 * exact);
    // Few samples would be trusted too far: they are believed to be as noisy as all of a block.
    partial.samples = {0, 8};
    EXPECT_GT(partial.relative_error(), 1.3 * exact);
}

TEST(Partial, OfOneSampleTellsItsErrorByNeighboursAlone) {
    Partial partial = noisy(2.0, 0.01, 0.0);
    partial.samples = {0, 1};
    const double exact = std::sqrt(0.01 / 4.01);
    EXPECT_NEAR(partial.relative_error(), exact, 0.15 * exact);
    partial.image = LayeredImage({0, 0, 2, 1}, {"beauty"}, channel_names(0));
    EXPECT_TRUE(std::isinf(partial.relative_error()));
}

TEST(Partial, KeepsThatItMissesTheTolerance) {
    const test::TemporaryFolder folder;
    Frame frame(width, height, plan);
    for (const Bucket& bucket : {left, right}) {
        Partial partial = make_partial(bucket, {0, bucket == left ? 16 : 8}, "shot");
        partial.unmet = bucket == left;
        const std::string path = folder.path("partial.exr");
        partial.write(path);
        const Partial back = Partial::read(path);
        EXPECT_EQ(back.unmet, partial.unmet);
        frame.add(back);
    }
    EXPECT_EQ(frame.unmet_buckets(), 1);
}

TEST(Frame, PlanMustTileTheImage) {
    EXPECT_NE(refusal([] { Frame(width, height, {{left, 16}}); }), "");
    EXPECT_NE(refusal([] { Frame(width, height, {{left, 16}, {left, 16}, {right, 8}}); }), "");
    EXPECT_NE(refusal([] { Frame(width, height, {{left, 16}, {{15, 0, 24, 12}, 8}}); }), "");
    EXPECT_NE(refusal([] { Frame(width, height, {{left, 16}, {{16, 0, 25, 12}, 8}}); }), "");
    EXPECT_NE(refusal([] { Frame(width, height, {{left, 16}, {right, 0}}); }), "");
    EXPECT_NE(refusal([] { Frame(width, height, {}); }), "");
    EXPECT_EQ(refusal([] { Frame(width, height, plan); }), "");
}

TEST(Frame, IsCompleteOnlyWithEveryBucketAndSample) {
    const test::TemporaryFolder folder;
    const std::string path = folder.path("frame.exr");
    Frame frame(width, height, plan);
    EXPECT_NE(refusal([&] { frame.write(path, false, {}); }), "");
    frame.add(make_partial(left, {0, 8}, "shot"));
    frame.add(make_partial(right, {0, 8}, "shot"));
    // The line says what is missing.
    EXPECT_NE(refusal([&] { frame.write(path, false, {}); }).find("[8, 16)"), std::string::npos);
    EXPECT_FALSE(std::filesystem::exists(path));
    frame.add(make_partial(left, {8, 16}, "shot"));
    frame.write(path, false, {});
    const ExrFile file = read_exr(path);
    EXPECT_EQ(file.image.window(), (Bucket{0, 0, width, height}));
    EXPECT_EQ(file.image.looks(), (std::vector<std::string>{"hero", "fill"}));
}

TEST(Frame, TakesAsManySamplesAsAnOpenBucketsOnePartialHas) {
    const test::TemporaryFolder folder;
    Frame frame(width, height, {{left, std::nullopt}, {right, std::nullopt}});
    const auto refused = [&](const Partial& partial) {
        return !refusal([&] { frame.add(partial); }).empty();
    };
    EXPECT_TRUE(refused(make_partial(left, {4, 8}, "shot"))) << "after a gap";
    EXPECT_FALSE(refused(make_partial(left, {0, 24}, "shot")));
    EXPECT_TRUE(refused(make_partial(left, {24, 32}, "shot"))) << "a second one";
    EXPECT_NE(refusal([&] { frame.write(folder.path("frame.exr"), false, {}); }), "");
    EXPECT_FALSE(refused(make_partial(right, {0, 6}, "shot")));
    frame.write(folder.path("frame.exr"), false, {});
    // 16 columns of 24 samples and 8 of 6.
    EXPECT_DOUBLE_EQ(frame.mean_samples(), 18.0);
}

TEST(Frame, OfManyShortRangesIsTheMeanOfTheirSamples) {
    constexpr int samples = 1000;
    Frame frame(width, height, {{{0, 0, width, height}, samples}});
    double sum = 0.0;
    for (int i = 0; i < samples; ++i) {
        Partial partial = make_partial({0, 0, width, height}, {i, i + 1}, "shot", {"beauty"});
        // Each late sample moves the mean of all before it by less than a float's last digit.
        const float opacity = i < 300 ? 1.0f : 1.0f - 1e-5f;
        sum += double{opacity};
        partial.image.plane(0, Partial::a)[0] = opacity;
        frame.add(partial);
    }
    EXPECT_NEAR(double{frame.image().plane(0, Partial::a)[0]}, sum / samples, 5e-7);
}

TEST(Frame, RefusesWhatIsDoubledMissingOrForeign) {
    Frame frame(width, height, plan);
    frame.add(make_partial(left, {0, 8}, "shot"));
    const auto refused = [&](const Partial& partial) {
        return !refusal([&] { frame.add(partial); }).empty();
    };
    EXPECT_TRUE(refused(make_partial(left, {0, 8}, "shot"))) << "twice";
    EXPECT_TRUE(refused(make_partial(left, {4, 12}, "shot"))) << "overlapping";
    EXPECT_TRUE(refused(make_partial(left, {9, 16}, "shot"))) << "after a gap";
    EXPECT_TRUE(refused(make_partial(left, {8, 17}, "shot"))) << "more than planned";
    EXPECT_TRUE(refused(make_partial(left, {8, 8}, "shot"))) << "empty";
    EXPECT_TRUE(refused(make_partial({0, 0, 8, 12}, {8, 16}, "shot"))) << "not a planned bucket";
    EXPECT_TRUE(refused(make_partial(left, {8, 16}, "other"))) << "of another frame";
    EXPECT_TRUE(refused(make_partial(left, {8, 16}, "shot", {"hero"}))) << "lacking a look";
    EXPECT_TRUE(refused(make_partial(left, {8, 16}, "shot", {"fill", "hero"}))) << "looks swapped";
    EXPECT_TRUE(refused(make_partial(left, {8, 16}, "shot", {"hero", "fill"}, 2))) << "with orders";
    Partial foreign = make_partial(left, {8, 16}, "shot");
    foreign.width = width + 1;
    EXPECT_TRUE(refused(foreign)) << "of another image size";
    // After all the refusals the frame still takes what is right.
    EXPECT_FALSE(refused(make_partial(left, {8, 16}, "shot")));
    EXPECT_TRUE(refused(make_partial(left, {16, 24}, "shot"))) << "beyond the end";
    EXPECT_FALSE(refused(make_partial(right, {0, 8}, "shot")));
}

std::string read_bytes(const std::string& path) {
    std::ifstream file(path, std::ios::binary);
    std::ostringstream bytes;
    bytes << file.rdbuf();
    return bytes.str();
}

void write_bytes(const std::string& path, const std::string& bytes) {
    std::ofstream(path, std::ios::binary) << bytes;
}

bool same(const Partial& a, const Partial& b) {
    return a.width == b.width && a.height == b.height && a.samples == b.samples &&
           a.identity == b.identity && a.bounded_paths == b.bounded_paths &&
           a.image.window() == b.image.window() && a.image.looks() == b.image.looks() &&
           a.image.channels() == b.image.channels() && a.image.data() == b.image.data();
}

TEST(PartialFile, ComesBackAsItWas) {
    const test::TemporaryFolder folder;
    const std::string path = folder.path("partial.exr");
    for (const std::size_t orders : {0u, 1u, 12u}) {
        const Partial partial = make_partial({3, 5, 11, 9}, {4, 7}, "a1b2", {"hero", "x"}, orders);
        partial.write(path);
        EXPECT_TRUE(same(Partial::read(path), partial)) << orders;
    }
    // Nothing temporary is left beside it.
    const std::filesystem::directory_iterator files(std::filesystem::path(path).parent_path());
    EXPECT_EQ(std::distance(begin(files), end(files)), 1);
}

TEST(PartialFile, TruncationIsSeen) {
    const test::TemporaryFolder folder;
    const std::string path = folder.path("partial.exr"), cut = folder.path("cut.exr");
    make_partial(left, {0, 8}, "shot").write(path);
    const std::string bytes = read_bytes(path);
    for (std::size_t length = 0; length < bytes.size(); length += 1 + bytes.size() / 97) {
        write_bytes(cut, bytes.substr(0, length));
        EXPECT_NE(refusal([&] { Partial::read(cut); }), "") << length << " of " << bytes.size();
    }
    write_bytes(cut, bytes.substr(0, bytes.size() - 1));
    EXPECT_NE(refusal([&] { Partial::read(cut); }), "");
    EXPECT_NE(refusal([&] { Partial::read(folder.path("absent.exr")); }), "");
}

TEST(PartialFile, AnyFlippedBitIsSeenOrChangesNothing) {
    const test::TemporaryFolder folder;
    const std::string path = folder.path("partial.exr"), flipped = folder.path("flipped.exr");
    const Partial partial = make_partial({0, 0, 6, 4}, {0, 8}, "shot");
    partial.write(path);
    const std::string bytes = read_bytes(path);
    Random random(4);
    int seen = 0;
    for (std::size_t at = 0; at < bytes.size(); at += 2) {
        std::string damaged = bytes;
        damaged[at] = static_cast<char>(damaged[at] ^ (1u << (random.bits() & 7)));
        write_bytes(flipped, damaged);
        try {
            // A flip may meet padding or an attribute that says nothing of the partial.
            EXPECT_TRUE(same(Partial::read(flipped), partial)) << "byte " << at;
        } catch (const InputError&) {
            ++seen;
        }
    }
    EXPECT_GT(seen, int(bytes.size() * 3 / 8));
}

TEST(PartialFile, CannotBeWrittenIntoNowhere) {
    const test::TemporaryFolder folder;
    EXPECT_THROW(make_partial(left, {0, 8}, "shot").write(folder.path("absent/partial.exr")),
                 std::runtime_error);
}

TEST(Pool, EqualsOneRange) {
    // Ranges of a noisy render, merged in order, against the whole: mean, variance, depth, orders.
    const auto volume = test::volume_of(test::noise_grid(12, 2, 0.1));
    const Camera camera(V3d(0.6, 0.6, -3.0), V3d(0.6, 0.6, 0.6), V3d(0.0, 1.0, 0.0), 30.0);
    const Scene scene =
        test::make_scene(volume, camera, {test::constant_dome()}, {2.0f, Color(0.8f, 0.9f, 1.0f)});
    const Transport transport =
        test::transport_of("multiple", 3, {{"hero"}, {"low", 0.5f, 0.5f, 0.5f}});
    Control control;
    const auto range = [&](int first, int last) {
        return render(scene, transport,
                      {{0, 0, 16, 16}, {first, last}, 5, 1, *transport.max_bounces}, 0, control);
    };
    const Partial whole = range(0, 64);
    for (const auto& cuts : {std::vector<int>{0, 32, 64}, std::vector<int>{0, 1, 2, 3, 5, 64},
                             std::vector<int>{0, 16, 32, 48, 63, 64}}) {
        Frame frame(16, 16, {{{0, 0, 16, 16}, 64}});
        for (std::size_t i = 0; i + 1 < cuts.size(); ++i) frame.add(range(cuts[i], cuts[i + 1]));
        for (std::size_t look = 0; look < 2; ++look) {
            for (std::size_t c = 0; c < whole.image.channels().size(); ++c) {
                const float* const one = whole.image.plane(look, c);
                const float* const pooled = frame.image().plane(look, c);
                for (std::size_t i = 0; i < 256; ++i) {
                    ASSERT_NEAR(pooled[i], one[i], 1e-6 * std::abs(one[i]) + 1e-9)
                        << whole.image.channels()[c] << " of look " << look << ", pixel " << i;
                }
            }
        }
    }
}

}  // namespace
}  // namespace pileus
