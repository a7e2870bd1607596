// One sample of one pixel: its random numbers, its scatter events and what it finds.
#pragma once

#include "bridge.h"
#include "geometry.h"
#include "random.h"

#include <algorithm>
#include <array>
#include <cstdint>
#include <optional>
#include <vector>

namespace pileus {

enum StreamPurpose : std::uint64_t {
    walk_stream,
    light_stream,
    bridge_stream,
    chain_stream,
    stream_purposes
};

/// The random numbers of one path: stratified ones for its first dimensions, and independent
/// streams named by what they are for, so that no part of a path can shift the numbers of another.
class PathRandom {
  public:
    using Point = std::array<float, sobol::dimensions>;

    PathRandom(std::uint64_t pixel_key, std::uint32_t sample)
        : first(sobol::point(sample, hash_key(pixel_key, camera_points))),
          pixel_key_(pixel_key),
          sample_(sample),
          key_(hash_key(pixel_key, sample)) {}

    /// The pixel's x and y, the distance to the first event, and there the choice of lobe.
    const Point first;

    /// Those of walk `k` of so many that go on from the first event: among all walks of the pixel's
    /// samples they are as stratified as those of its samples.
    PathRandom walk(int k, int walks) const {
        PathRandom numbers = *this;
        numbers.sample_ =
            sample_ * static_cast<std::uint32_t>(walks) + static_cast<std::uint32_t>(k);
        numbers.key_ = hash_key(key_, walk_keys + static_cast<std::uint64_t>(k));
        numbers.light_.reset();
        return numbers;
    }

    /// At the first event: the direction towards a light, the shadow ray's first flight, and the
    /// choice of bridges. Many paths have none.
    const Point& light() const {
        if (!light_) light_ = stratified(light_points);
        return *light_;
    }

    /// Of a chain that events from n on share: the directions of the two events next to the light.
    Point chain(int n, Random& stream) const {
        if (n == 0) return stratified(chain_points);
        const auto [u1, u2] = stream.pair();
        const auto [u3, u4] = stream.pair();
        return {u1, u2, u3, u4};
    }

    /// With what a walk goes on from event n: two numbers for the direction, one for the flight and
    /// one for the next event's shadow. For its first events they are stratified.
    Point onward(int n, Random& walk) const {
        constexpr int stratified_events = 6;
        if (n < stratified_events) return stratified(walk_points + static_cast<std::uint64_t>(n));
        const auto [u1, u2] = walk.pair();
        const auto [u3, u4] = walk.pair();
        return {u1, u2, u3, u4};
    }

    Random stream(StreamPurpose purpose, std::uint64_t index = 0) const {
        return Random(hash_key(key_, index * stream_purposes + purpose));
    }

  private:
    // Sequences of the pixel, of which each sample has a point. Their keys lie beyond the samples'.
    static constexpr std::uint64_t camera_points = 1ULL << 32, light_points = camera_points + 1,
                                   chain_points = camera_points + 2,
                                   walk_points = camera_points + 3;

    // A walk's key is a sample's, beyond all its streams.
    static constexpr std::uint64_t walk_keys = 1ULL << 32;

    Point stratified(std::uint64_t sequence) const {
        return sobol::point(sample_, hash_key(pixel_key_, sequence));
    }

    std::uint64_t pixel_key_;
    std::uint32_t sample_;
    std::uint64_t key_;
    mutable std::optional<Point> light_;
};

/// What one path finds: by look, and by order where they are wanted apart.
class PathRecord {
  public:
    PathRecord(std::size_t looks, std::size_t orders)
        : orders_(orders), radiance_(looks * orders) {}

    void clear() {
        std::fill(radiance_.begin(), radiance_.end(), Color(0.0f));
        sky = Color(0.0f);
        opacity = 0.0f;
        depth = 0.0;
        bounded = false;
    }

    void add(std::size_t look, int order, const Color& radiance) {
        const auto layer = std::min(static_cast<std::size_t>(order), orders_ - 1);
        radiance_[look * orders_ + layer] += radiance;
    }

    const Color& radiance(std::size_t look, std::size_t layer) const {
        return radiance_[look * orders_ + layer];
    }
    std::size_t orders() const { return orders_; }

    Color sky;             // seen through what is left of the ray, not part of any order
    float opacity = 0.0f;  // 1 - T along the camera ray, or an unbiased estimate of it
    double depth = 0.0;    // of the first event along the view axis, world units
    bool bounded = false;  // ended by the bound on work

  private:
    std::size_t orders_;
    std::vector<Color> radiance_;
};

/// A scatter event: light that travels the path backwards comes along `direction`.
struct ScatterEvent {
    V3f position;             // local
    V3f direction;            // world, unit: the way the walk arrived
    Color weight;             // of the path up to here, this event's albedo included
    RecentChoices choices{};  // of the directions up to here
    float local = -1.0f;      // the extinction here, where a local step has led here
    float shadow = 0.0f;      // the number for its shadow, where it is not the first
};

}  // namespace pileus
