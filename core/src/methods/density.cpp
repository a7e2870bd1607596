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

    void trace(const CameraRay& ray, const PathRandom& random, PathRecord& record) override {
        const Medium& medium = scene_.medium;
        Random walk = random.stream(walk_stream);
        auto event = first_event(scene_, ray, random, walk, march_, record);
        for (int order = 0; event; ++order) {
            light_.add(*event, order, order + 1, random, record);
            if (order + 1 == orders_) return;
            const float u1 = walk.uniform(), u2 = walk.uniform();
            event->direction = medium.phase().sample(event->direction, u1, u2);
            const LocalRay ray_on = medium.ray(event->position, event->direction);
            march_.march(medium, ray_on, walk.uniform());
            if (march_.opacity() <= 0.0f) return;
            event->position = ray_on.at(march_.invert(walk.uniform()));
            event->weight *= medium.albedo() * march_.opacity();
            if (event->weight == Color(0.0f)) return;
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
