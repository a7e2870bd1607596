// `multiple`: Wrenninge's talk (SIGGRAPH 2015) to the letter. After a density-sampled first event
// the light is followed by a random walk that reads one interpolated voxel and inverts the phase
// function once a bounce: Woodcock tracking with the majorant approximated by the local extinction.
//
// The talk is silent where the local extinction d is 0. A step of -ln(1-u)/d then has no length,
// and MoonRay's walk ends. Here a point without density is no scatter event: the walk keeps its
// direction and goes on by exact delta tracking to its next event. Where d is tiny but not 0 the
// walk leaps, to the letter; that is the method's bias. A step out of the volume that meets nothing
// more ends the path.
//
// Beyond the talk, bridges find the light of distant lights with less noise; they fly by the same
// steps, so the mean is the talk's.
#include "first_event.h"
#include "methods.h"

namespace pileus {

namespace {

class Multiple final : public Method {
  public:
    Multiple(const Scene& scene, const Transport& transport)
        : scene_(scene),
          orders_(*transport.max_bounces),
          schedule_(scene.medium),
          light_(scene, schedule_, transport.looks, Flights::local) {}

    Path trace(const CameraRay& ray, const PathRandom& random, PathRecord& record,
               PathKit& kit) override {
        const Medium& medium = scene_.medium;
        Random walk = random.stream(walk_stream);
        auto event = first_event(scene_, ray, random, walk, march_, record);
        if (!event) co_return;
        for (int order = 0;; ++order) {
            light_.ask(*event, order, order + 1, random, kit.shadows);
            light_.ask_bridges(*event, order, orders_, random, kit.bridges);
            const bool last = order + 1 == orders_;
            const auto [u1, u2, flown, shadow] = random.onward(order, walk);
            Turn turn{&medium.phase(), event->direction, u1, u2};
            Track flight{.medium = &medium,
                         .ray = {event->position, V3f(0.0f)},
                         .random = walk,
                         .first = flown,
                         .local = event->local};
            if (!last) kit.tracker.add(Estimator::local_step, turn, flight);
            do {
                kit.cast(light_);
                co_await tracked;
            } while (kit.settle(light_, record));
            if (last || flight.distance == Track::none) co_return;
            walk = flight.random;
            event->position = flight.ray.at(flight.distance);
            event->local = flight.local;
            event->direction = turn.onward.direction;
            event->weight *= medium.albedo();
            event->choices.add(turn.onward.inverse_density);
            event->shadow = shadow;
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

std::unique_ptr<Method> make_multiple(const Scene& scene, const Transport& transport) {
    return std::make_unique<Multiple>(scene, transport);
}

}  // namespace pileus
