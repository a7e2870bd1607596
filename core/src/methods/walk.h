// The random walk from event to event, as `multiple` and `density` share it: they differ in how
// the next event is found.
#pragma once

#include "../method.h"

#include <optional>

namespace pileus {

struct NextEvent {
    V3f position;
    float weight;         // the probability that there is one, where it is not sampled; otherwise 1
    bool vacuum = false;  // there is nothing here: the walk goes on by delta tracking
};

/// Gathers direct light at the event and at those that follow, at most `orders` of them.
/// `next(LocalRay, u, Random&) -> std::optional<NextEvent>` finds the next event of a ray from the
/// last by a number u in [0, 1); a path ends where there is none.
template <typename Next>
Path walk_on(const Medium& medium, ScatterEvent event, int orders, const DirectLight& light,
             const PathRandom& random, Random walk, PathRecord& record, PathKit& kit, Next next) {
    for (int order = 0;; ++order) {
        light.ask(event, order, order + 1, random, kit.shadows);
        light.ask_bridges(event, order, orders, random, kit.bridges);
        do {
            kit.cast();
            co_await tracked;
        } while (kit.settle(light, record));
        if (order + 1 == orders) co_return;
        const auto [u1, u2, flown, shadow] = random.onward(order, walk);
        const auto turned = medium.phase().sample(event.direction, u1, u2);
        event.direction = turned.direction;
        event.choices.add(turned.inverse_density);
        const LocalRay onward = medium.ray(event.position, event.direction);
        const std::optional<NextEvent> found = next(onward, flown, walk);
        if (!found) co_return;
        event.position = found->position;
        event.shadow = shadow;
        if (found->vacuum) {
            const float first = walk.uniform();
            Track flight{.medium = &medium,
                         .ray = {found->position, onward.direction},
                         .random = walk,
                         .first = first};
            kit.tracker.add(Estimator::collision, flight);
            co_await tracked;
            if (flight.distance == Track::none) co_return;
            walk = flight.random;
            event.position = flight.ray.at(flight.distance);
        }
        event.weight *= medium.albedo() * found->weight;
        if (event.weight == Color(0.0f)) co_return;
    }
}

}  // namespace pileus
