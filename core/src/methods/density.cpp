// `density`: what the talk argues against, density sampling with a full march at every bounce.
// Accurate to the march's step, and dear.
#include "first_event.h"
#include "methods.h"
#include "walk.h"

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
        const auto event = first_event(scene_, ray, random, walk, march_, record);
        if (!event) return {};
        return walk_on(
            medium, *event, orders_, light_, random, walk, record, kit,
            [this](const LocalRay& onward, float u, Random& numbers) -> std::optional<NextEvent> {
                march_.march(scene_.medium, onward, numbers.uniform());
                if (march_.opacity() <= 0.0f) return std::nullopt;
                return NextEvent{onward.at(march_.invert(u)), march_.opacity()};
            });
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
