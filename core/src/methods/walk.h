// The random walk from event to event, as `multiple` and `density` share it: they differ in how
// the next event is found.
#pragma once

#include "../path.h"

#include <optional>

namespace pileus {

struct NextEvent {
    V3f position;
    float weight;  // the probability that there is one, where it is not sampled; otherwise 1
};

/// Gathers direct light at the event and at those that follow, at most `orders` of them.
/// `next(LocalRay, u) -> std::optional<NextEvent>` finds the next event of a ray from the last by a
/// number u in [0, 1); a path ends where there is none.
template <typename Next>
void walk_on(const Medium& medium, ScatterEvent event, int orders, DirectLight& light,
             const PathRandom& random, Random& walk, PathRecord& record, const Next& next) {
    for (int order = 0;; ++order) {
        light.add(event, order, order + 1, random, record);
        if (order + 1 == orders) return;
        const auto [u1, u2, u3] = random.onward(order, walk);
        event.direction = medium.phase().sample(event.direction, u1, u2);
        const std::optional<NextEvent> found =
            next(medium.ray(event.position, event.direction), u3);
        if (!found) return;
        event.position = found->position;
        event.weight *= medium.albedo() * found->weight;
        if (event.weight == Color(0.0f)) return;
    }
}

}  // namespace pileus
