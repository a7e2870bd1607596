// The media that light meets from event to event of a walk: the scene's own throughout, or after
// the first events ones reduced by the similarity relation (Wyman, Patterson & Wilson 1989; Zhao,
// Ramamoorthi & Bala 2014), in which one event stands for several.
#pragma once

#include "medium.h"

#include <algorithm>
#include <limits>
#include <vector>

namespace pileus {

class Schedule {
  public:
    /// The medium itself at every event. It must outlive the schedule.
    explicit Schedule(const Medium& medium);

    /// The medium itself for the events before `from`, at least 1, and reduced ones after them: see
    /// schedule.cpp.
    Schedule(const Medium& medium, int from);

    /// The medium whose particles event n meets: its phase function and albedo are the event's.
    const Medium& at(int n) const { return n == 0 ? *own_ : onward(n - 1); }

    /// The medium that light crosses beyond event n, towards the next event and the lights.
    const Medium& onward(int n) const { return media_[index(n)]; }

    /// The order i of Eq. 1 that event n stands for: n in the medium itself, growing faster in
    /// reduced ones, where one event does the work of several (whole ones, so that b can be
    /// regraded).
    int order(int n) const;

    /// How many events are met in the medium itself, at the most.
    int plain() const { return plain_; }

    /// How many events have orders below a bound.
    int events(int orders) const;

  private:
    float exact_order(int n) const;

    std::size_t index(int n) const {
        return std::min(static_cast<std::size_t>(n), media_.size() - 1);
    }

    const Medium* own_;
    std::vector<Medium> media_;  // beyond each event; the last for all further ones
    std::vector<float> order_;   // of each event; further ones follow at a steady pace
    float pace_ = 1.0f;
    int plain_ = std::numeric_limits<int>::max();
};

}  // namespace pileus
