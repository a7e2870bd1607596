// `contrast`: the approximation of Wrenninge, Kulla & Lundqvist (2013): the first event gathers the
// direct light of every order, as if the light had been scattered and spread on its way in. With
// one octave it is `single`.
#include "first_event.h"
#include "methods.h"

namespace pileus {

namespace {

class Contrast final : public Method {
  public:
    Contrast(const Scene& scene, const Transport& transport)
        : scene_(scene),
          octaves_(*transport.max_bounces),
          schedule_(scene.medium),
          light_(scene, schedule_, transport.looks, Flights::other) {}

    Path trace(const CameraRay& ray, const PathRandom& random, PathRecord& record,
               PathKit& kit) override {
        Random walk = random.stream(walk_stream);
        const auto event = first_event(scene_, ray, random, walk, march_, record);
        if (!event) co_return;
        light_.ask(*event, 0, octaves_, random, kit.shadows);
        kit.shadows.cast(kit.tracker);
        co_await tracked;
        kit.shadows.settle(record);
    }

    int orders_at_once() const override { return octaves_; }

  private:
    const Scene& scene_;
    int octaves_;
    Schedule schedule_;
    DirectLight light_;
    DensityMarch march_;
};

}  // namespace

std::unique_ptr<Method> make_contrast(const Scene& scene, const Transport& transport) {
    return std::make_unique<Contrast>(scene, transport);
}

}  // namespace pileus
