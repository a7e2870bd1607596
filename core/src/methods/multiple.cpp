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
// Beyond the talk, and with its mean: bridges find the light of distant lights with less noise, and
// fly by the same steps; and two walks go on from each first event, for its march and its light
// take a good part of a sample's time and have little of the noise.
#include "first_event.h"
#include "methods.h"

namespace pileus {

namespace {

constexpr int walks = 2;  // on from a first event

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
        Random jitter = random.stream(walk_stream);
        const auto start = first_event(scene_, ray, random, jitter, march_, record);
        if (!start) co_return;
        light_.ask(*start, 0, 1, random, kit.shadows);
        for (int k = 0; k < walks; ++k) {
            const PathRandom numbers = random.walk(k, walks);
            Random walk = numbers.stream(walk_stream);
            ScatterEvent event = *start;
            event.weight *= 1.0f / static_cast<float>(walks);
            for (int order = 0;; ++order) {
                light_.ask_bridges(event, order, orders_, numbers, kit.bridges);
                const bool last = order + 1 == orders_;
                const auto [u1, u2, flown, shadow] = numbers.onward(order, walk);
                Turn turn{&medium.phase(), event.direction, u1, u2};
                Track flight{.medium = &medium,
                             .ray = {event.position, V3f(0.0f)},
                             .random = walk,
                             .first = flown,
                             .local = event.local};
                if (!last) kit.tracker.add(Estimator::local_step, turn, flight);
                do {
                    kit.cast(light_);
                    co_await tracked;
                } while (kit.settle(light_, record));
                if (last || flight.distance == Track::none) break;
                walk = flight.random;
                event.position = flight.ray.at(flight.distance);
                event.local = flight.local;
                event.direction = turn.onward.direction;
                event.weight *= medium.albedo();
                event.choices.add(turn.onward.inverse_density);
                event.shadow = shadow;
                if (event.weight == Color(0.0f)) break;
                light_.ask(event, order + 1, order + 2, numbers, kit.shadows);
            }
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
