// One sample of one pixel: its random numbers, what it finds, and the routine that gathers direct
// light at a scatter event by Eq. 1.
#pragma once

#include "random.h"
#include "scene.h"

#include <array>
#include <cstdint>
#include <vector>

namespace pileus {

/// The random numbers of one path: stratified ones for its first dimensions, and independent
/// streams named by what they are for, so that no part of a path can shift the numbers of another.
struct PathRandom {
    PathRandom(std::uint64_t pixel_key, std::uint32_t sample)
        : first(sobol::point(sample, hash_key(pixel_key, 0))),
          second(sobol::point(sample, hash_key(pixel_key, 1))),
          key(hash_key(pixel_key, sample + 2ULL)) {}

    Random stream(std::uint64_t purpose) const { return Random(hash_key(key, purpose)); }
    Random stream(std::uint64_t purpose, std::uint64_t a, std::uint64_t b) const {
        return Random(hash_key(hash_key(hash_key(key, purpose), a), b));
    }

    // The pixel's x and y, the distance to the first event, and there the choice of lobe.
    std::array<float, sobol::dimensions> first;
    // At the first event: the direction towards a light, and the walk's.
    std::array<float, sobol::dimensions> second;
    std::uint64_t key;
};

enum StreamPurpose : std::uint64_t { walk_stream, light_stream, lobe_stream, roulette_stream };

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
    V3f position;   // local
    V3f direction;  // world, unit: the way the walk arrived
    Color weight;   // of the path up to here, this event's albedo included
};

/// How the sky reaches a physical look (a = b = c = 1).
enum class Sky {
    shadow_rays,  // like any light
    walk  // by the walk itself as it leaves the medium, at no cost: only where its flights are
          // unbiased
};

/// Adds the direct light at an event, Eq. 1 for the orders [first, last), to every look: for each
/// light
///   sigma_s b^i L p(w_i, w_o, c^i g) exp(-a^i integral of sigma_t to the light).
/// Looks share the directions, and the shadow rays where they share the power a^i.
class DirectLight {
  public:
    DirectLight(const Scene& scene, const std::vector<Look>& looks, Sky sky);

    void add(const ScatterEvent& event, int first, int last, const PathRandom& random,
             PathRecord& record);

    /// Adds what a walk that has left the medium sees of the sky, for the looks whose `Sky` is the
    /// walk: it scattered into `direction` at `event`, of the given order, and met nothing more.
    void add_escape(const ScatterEvent& event, const V3f& direction, int order,
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

    const Scene& scene_;
    const std::vector<Look>& looks_;
    Sky sky_;
    int first_ = -1, last_ = -1;
    std::vector<Term> terms_;
};

}  // namespace pileus
