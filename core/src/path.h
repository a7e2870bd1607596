// One sample of one pixel: its random numbers, what it finds, and the routine that gathers direct
// light at a scatter event by Eq. 1.
#pragma once

#include "bridge.h"
#include "random.h"
#include "scene.h"
#include "schedule.h"

#include <array>
#include <cstdint>
#include <optional>
#include <span>
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

    /// At the first event: the direction towards a light. Many paths have none.
    const Point& light() const {
        if (!light_) light_ = stratified(light_points);
        return *light_;
    }

    /// With what a walk goes on from event n: two numbers for the direction and one for the flight.
    /// For its first events they are stratified.
    std::array<float, 3> onward(int n, Random& walk) const {
        if (n >= 3) return {walk.uniform(), walk.uniform(), walk.uniform()};
        const Point point = stratified(walk_points + static_cast<std::uint64_t>(n));
        return {point[0], point[1], point[2]};
    }

    Random stream(StreamPurpose purpose, std::uint64_t index = 0) const {
        return Random(hash_key(key_, index * stream_purposes + purpose));
    }

  private:
    // Sequences of the pixel, of which each sample has a point. Their keys lie beyond the samples'.
    static constexpr std::uint64_t camera_points = 1ULL << 32, light_points = camera_points + 1,
                                   walk_points = camera_points + 2;

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
};

/// How a method flies from event to event.
enum class Flights {
    tracked,  // delta tracking, unbiased
    other
};

/// Adds the direct light at an event, Eq. 1 for the orders of the events [first, last), to every
/// look: for each light
///   sigma_s b^i L p(w_i, w_o, c^i g) exp(-a^i integral of sigma_t to the light).
/// Looks share the directions, and the shadow rays where they share the power a^i.
///
/// Where flights are tracked, two more techniques find the same light with less noise:
/// - the sky reaches a physical look (a = b = c = 1) by the walk itself as it leaves the medium, at
///   no cost (`add_escape`);
/// - distant lights are also reached by bridges (`add_bridges`). Of a path's last phase functions p
///   one is then evaluated and the others sampled. Weighed by the balance heuristic (Veach 1997)
///   every technique counts the same, the harmonic sum 1 / (sum of 1 / p): it has a peak only where
///   all of them do.
class DirectLight {
  public:
    DirectLight(const Scene& scene, const Schedule& schedule, const std::vector<Look>& looks,
                Flights flights);

    void add(const ScatterEvent& event, int first, int last, const PathRandom& random,
             PathRecord& record);

    /// Adds the light that reaches event n by way of further events, up to event `end`, between it
    /// and each distant light.
    void add_bridges(const ScatterEvent& event, int n, int end, const PathRandom& random,
                     PathRecord& record);

    /// Adds what a walk that has left the medium sees of the sky, for the physical looks: it
    /// scattered into `direction` at event n, of which 1 / density is given, and met nothing more.
    void add_escape(const ScatterEvent& event, const V3f& direction, float inverse_density, int n,
                    PathRecord& record) const;

  private:
    struct Term {
        std::size_t look;
        int order;
        float weight;
        HenyeyGreenstein phase;
        float power;
        bool walk;  // its sky comes by the walk
    };

    void set_terms(int first, int last);
    bool bridged(int n) const;
    const std::optional<Chain>& chain(std::size_t light, int n, const PathRandom& random);
    std::optional<ScatterEvent> fly(const ScatterEvent& from, int n, std::span<const V3f> chain,
                                    Random& random) const;

    const Scene& scene_;
    const Schedule& schedule_;
    const std::vector<Look>& looks_;
    bool tracked_;
    bool all_walk_;
    int first_ = -1, last_ = -1;
    std::vector<Term> terms_;
    int reach_;  // the most events of a bridge; 0 where there are none
    std::vector<std::optional<Chain>> chains_;  // by light
};

}  // namespace pileus
