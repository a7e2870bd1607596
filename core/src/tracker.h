// Tracking: along each ray a Poisson process of tentative collisions under the local majorants
// (Woodcock et al. 1965; Novak et al. 2018). One routine serves distance sampling, collisions that
// are made to happen and transmittance alike, and follows many rays at once, a ray a lane.
#pragma once

#include "medium.h"
#include "random.h"

#include <array>
#include <limits>
#include <span>
#include <vector>

namespace pileus {

enum class Estimator {
    /// Delta tracking: the distance to the next true collision, distributed as transmittance times
    /// extinction.
    collision,
    /// The talk's step (Wrenninge 2015), through a medium that is taken to be everywhere as dense
    /// as where the step starts: Woodcock tracking with the majorant approximated by the local
    /// extinction. The ray's origin, which lies in the medium's box, moves to the step's end. From
    /// where there is no density it goes on as in delta tracking.
    local_step,
    /// Weighted delta tracking (Novak et al. 2018): at each tentative collision a part of the
    /// weight collides and the rest goes on. One of the collisions is kept, drawn by its part.
    /// Light and opacity where the medium is thin are then no longer a matter of all or nothing.
    /// When little is left it goes on as in delta tracking, all of it at once.
    forced_collision,
    /// Ratio tracking (Novak et al. 2014): an unbiased estimate of T^power, for power in [0, 1].
    /// The power scales the extinction inside the estimator, for E[T^a] is not E[T]^a, and the
    /// majorant with it: light that a look lets through easily is also cheap. Estimates below a
    /// tenth live on with that chance.
    transmittance,
};

/// A scatter event: how light goes on from there is drawn as its ray is tracked, also many at once.
struct Turn {
    const HenyeyGreenstein* phase;
    V3f arriving;  // world, unit
    float u1, u2;  // of which the direction is drawn, uniform in [0, 1)
    HenyeyGreenstein::Sample onward{};
};

/// A ray, and what tracking has found along it.
struct Track {
    static constexpr float none = std::numeric_limits<float>::infinity();

    const Medium* medium;
    LocalRay ray;
    Turn* turn = nullptr;  // of which the ray's direction comes, if there is one
    Random random;         // goes on where tracking has left it
    float first;           // of which the first free flight is drawn, uniform in [0, 1)
    float local = -1.0f;   // the extinction at the ray's origin; below 0 where it is not known
    float power = 1.0f;    // of the transmittance
    float rate = 1.0f;     // of collisions, over the majorant; at least 1. More of them, less noise
    float distance = none;  // of the collision; none where the ray leaves the medium
    // Of a forced collision: an unbiased estimate of 1 - T, in [0, 1]. Of transmittance: that.
    float weight = 0.0f;
};

/// Follows rays through media over one tree.
class Tracker {
  public:
    /// How many rays at once this machine can follow, the most last.
    static std::vector<int> widths();

    /// `width` is one of `widths`, and changes nothing of what is found.
    explicit Tracker(const BrickTree& tree, Boxes boxes = Boxes::bricks,
                     int width = widths().back());

    /// Lays down a ray, which must stay where it is until `run` has returned.
    void add(Estimator estimator, Track& track) {
        waiting_[static_cast<std::size_t>(estimator)].push_back(&track);
    }

    /// The same for a flight to the next event, in a direction that is drawn. The turn, too, must
    /// stay.
    void add(Estimator estimator, Turn& turn, Track& flight) {
        flight.turn = &turn;
        turning_[static_cast<std::size_t>(estimator)].push_back(&flight);
    }

    /// Follows all rays that were laid down. What is found along one does not depend on the others,
    /// nor on the width.
    void run();

  private:
    const BrickTree* tree_;
    Boxes boxes_;
    void (*follow_)(Estimator, const BrickTree&, Boxes, std::span<Track*>);
    std::array<std::vector<Track*>, 4> waiting_, turning_;  // by estimator
};

}  // namespace pileus
