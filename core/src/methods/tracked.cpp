// `reference` and `similarity`: volumetric path tracing by delta tracking under exact local
// majorants, with ratio tracking for shadows and Russian roulette on weights that absorption has
// made small. In the medium itself (`reference`) it is unbiased, the truth for the other methods;
// in media reduced after the first events (`similarity`) it needs far fewer events, for a small
// bias.
#include "methods.h"

#include <algorithm>
#include <cmath>

namespace pileus {

namespace {

class Tracked final : public Method {
  public:
    Tracked(const Scene& scene, const Transport& transport, Schedule schedule)
        : scene_(scene),
          schedule_(std::move(schedule)),
          bounded_(!transport.max_bounces),
          events_(schedule_.events(transport.max_bounces.value_or(most_events))),
          first_rate_(first_rate(scene)),
          light_(scene, schedule_, transport.looks, Flights::tracked) {}

    Path trace(const CameraRay& ray, const PathRandom& random, PathRecord& record,
               PathKit& kit) override {
        Random walk = random.stream(walk_stream);
        Track camera{.medium = &scene_.medium,
                     .ray = *ray.volume,
                     .random = walk,
                     .first = random.first[2],
                     .rate = first_rate_};
        kit.tracker.add(Estimator::forced_collision, camera);
        co_await tracked;
        walk = camera.random;
        const float opacity = seldom(camera.weight, walk);
        if (opacity == 0.0f) co_return;
        record.opacity = opacity;
        record.depth = (ray.entry_distance + camera.distance) * ray.depth_per_distance;
        ScatterEvent event{ray.volume->at(camera.distance), ray.direction,
                           scene_.medium.albedo() * opacity};
        for (int n = 0;; ++n) {
            light_.ask(event, n, n + 1, random, kit.shadows);
            light_.ask_bridges(event, n, events_, random, kit.bridges);
            const auto [u1, u2, flown, shadow] = random.onward(n, walk);
            const Medium& medium = schedule_.onward(n);
            Turn turn{&schedule_.at(n).phase(), event.direction, u1, u2};
            Track flight{.medium = &medium,
                         .ray = {event.position, V3f(0.0f)},
                         .random = walk,
                         .first = flown};
            kit.tracker.add(Estimator::collision, turn, flight);
            do {
                kit.cast(light_);
                co_await tracked;
            } while (kit.settle(light_, record));
            const auto& [direction, inverse_density] = turn.onward;
            if (flight.distance == Track::none) {
                light_.add_escape(event, direction, inverse_density, n, record);
                co_return;
            }
            if (n + 1 == events_) {
                record.bounded = bounded_;
                co_return;
            }
            walk = flight.random;
            event.position = flight.ray.at(flight.distance);
            event.direction = direction;
            event.weight *= medium.albedo();
            event.choices.add(inverse_density);
            event.shadow = shadow;
            if (!survives(event.weight, opacity, walk)) co_return;
        }
    }

  private:
    /// Makes a first collision of little chance a seldom one of more.
    static float seldom(float chance, Random& random) {
        constexpr float least = 0.01f;
        if (chance >= least) return chance;
        return random.uniform() * least < chance ? least : 0.0f;
    }

    /// Russian roulette on weights that absorption has made small beside a path's first; a path
    /// without absorption is never ended.
    static bool survives(Color& weight, float first, Random& random) {
        const float small = 0.25f * first;
        const float most = max_component(weight);
        if (most >= small) return true;
        if (random.uniform() * small >= most) return false;
        weight *= small / most;
        return true;
    }

    /// Tentative collisions along a camera ray, over those of delta tracking: as many where the
    /// volume is thick, and more where a ray through all of it would have fewer than four.
    static float first_rate(const Scene& scene) {
        const auto bounds = scene.volume->world_bounds();
        if (!bounds) return 1.0f;
        const double thickness = scene.medium.majorant(scene.volume->tree().max()) *
                                 (bounds->second - bounds->first).length();
        return static_cast<float>(std::clamp(4.0 / thickness, 1.0, 8.0));
    }

    const Scene& scene_;
    Schedule schedule_;
    bool bounded_;  // whether only the bound on work ends a path
    int events_;
    float first_rate_;  // of tentative collisions along a camera ray
    DirectLight light_;
};

}  // namespace

std::unique_ptr<Method> make_reference(const Scene& scene, const Transport& transport) {
    return std::make_unique<Tracked>(scene, transport, Schedule(scene.medium));
}

std::unique_ptr<Method> make_similarity(const Scene& scene, const Transport& transport) {
    return std::make_unique<Tracked>(scene, transport,
                                     Schedule(scene.medium, transport.reduce_from));
}

}  // namespace pileus
