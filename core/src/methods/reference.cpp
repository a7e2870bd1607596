// `reference`: unbiased volumetric path tracing. Delta tracking under exact local majorants draws
// every event, ratio tracking every shadow, Russian roulette ends paths that have lost their
// weight; the truth for the other methods.
#include "../tracking.h"
#include "methods.h"

#include <cmath>

namespace pileus {

namespace {

class Reference final : public Method {
  public:
    Reference(const Scene& scene, const Transport& transport)
        : scene_(scene),
          orders_(transport.max_bounces.value_or(most_events)),
          light_(scene, transport.looks, Flights::tracked) {}

    void trace(const CameraRay& ray, const PathRandom& random, PathRecord& record) override {
        const Medium& medium = scene_.medium;
        Random walk = random.stream(walk_stream);
        LocalRay flight = *ray.volume;
        auto distance = delta_track(medium, flight, -std::log1p(-random.first[2]), walk);
        if (!distance) return;
        record.opacity = 1.0f;
        record.depth = (ray.entry_distance + *distance) * ray.depth_per_distance;

        ScatterEvent event{flight.at(*distance), ray.direction, medium.albedo()};
        for (int order = 0;; ++order) {
            light_.add(event, order, order + 1, random, record);
            const float u1 = order == 0 ? random.second()[2] : walk.uniform();
            const float u2 = order == 0 ? random.second()[3] : walk.uniform();
            const V3f direction = medium.phase().sample(event.direction, u1, u2);
            const float density = medium.phase().density(event.direction, direction);
            light_.add_bridges(event, order, orders_, random, record);
            flight = medium.ray(event.position, direction);
            distance = delta_track(medium, flight, walk.exponential(), walk);
            if (!distance) {
                light_.add_escape(event, direction, density, order, record);
                return;
            }
            if (order + 1 == orders_) {
                record.bounded = orders_ == most_events;
                return;
            }
            event = {flight.at(*distance),
                     direction,
                     event.weight * medium.albedo(),
                     {1.0f / density, event.inverse_density[0]}};
            if (!survives(event.weight, walk)) return;
        }
    }

  private:
    /// Russian roulette on weights that absorption has made small; a path without absorption is
    /// never ended.
    static bool survives(Color& weight, Random& random) {
        constexpr float small = 0.25f;
        const float most = max_component(weight);
        if (most >= small) return true;
        if (random.uniform() * small >= most) return false;
        weight *= small / most;
        return true;
    }

    const Scene& scene_;
    int orders_;
    DirectLight light_;
};

}  // namespace

std::unique_ptr<Method> make_reference(const Scene& scene, const Transport& transport) {
    return std::make_unique<Reference>(scene, transport);
}

}  // namespace pileus
