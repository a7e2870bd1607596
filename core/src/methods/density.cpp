// `density`: what the talk argues against, density sampling with a full march at every bounce.
// Accurate to the march's step, and dear.
#include "first_event.h"
#include "methods.h"

namespace pileus {

namespace {

class Density final : public Method {
  public:
    Density(const Scene& scene, const Transport& transport)
        : scene_(scene),
          orders_(*transport.max_bounces),
          schedule_(scene.medium),
          light_(scene, schedule_, transport.looks, Flights::other) {}

    Path trace(const CameraRay& ray, const PathRandom& random, PathRecord& record,
               PathKit& kit) override {
        const Medium& medium = scene_.medium;
        Random walk = random.stream(walk_stream);
        auto event = first_event(scene_, ray, random, walk, march_, record);
        if (!event) co_return;
        for (int order = 0;; ++order) {
            light_.ask(*event, order, order + 1, random, kit.shadows);
            kit.shadows.cast(kit.tracker);
            co_await tracked;
            kit.shadows.settle(record);
            if (order + 1 == orders_) co_return;
            const auto [u1, u2, flown, shadow] = random.onward(order, walk);
            event->direction = medium.phase().sample(event->direction, u1, u2).direction;
            const LocalRay onward = medium.ray(event->position, event->direction);
            march_.march(medium, onward, walk.uniform());
            if (march_.opacity() <= 0.0f) co_return;
            event->position = onward.at(march_.invert(flown));
            event->shadow = shadow;
            event->weight *= medium.albedo() * march_.opacity();
            if (event->weight == Color(0.0f)) co_return;
        }
    }

  private:
    const Scene& scene_;
    int orders_;
    Schedule schedule_;
    DirectLight light_;
    DensityMarch march_;
};

}  // namespace

std::unique_ptr<Method> make_density(const Scene& scene, const Transport& transport) {
    return std::make_unique<Density>(scene, transport);
}

}  // namespace pileus
