#include "schedule.h"

#include <ranges>

namespace pileus {

Schedule::Schedule(const Medium& medium) : own_(&medium), media_{medium}, order_{0.0f} {}

// Each event from there on stands for twice as many as the one before it, 1 - g doubling, until
// scattering is isotropic. Light that a reduced medium lets through unscattered has in truth been
// scattered forward on its way; so the shadow rays of event `from` - 1 cross the first reduced
// medium already, as the flight from it does, or that light would be lost.
Schedule::Schedule(const Medium& medium, int from) : own_(&medium), media_{medium}, order_{0.0f} {
    const float g = medium.phase().g();
    if (g <= 0.0f) return;
    plain_ = from;
    media_.assign(static_cast<std::size_t>(from - 1), medium);
    for (float reduced = g; reduced > 0.0f;) {
        reduced = std::max(0.0f, 2.0f * reduced - 1.0f);
        media_.push_back(medium.reduced(reduced));
    }
    for (std::size_t n = 0; n < media_.size(); ++n) {
        pace_ = (1.0f - at(static_cast<int>(n)).phase().g()) / (1.0f - g);
        order_.push_back(order_.back() + pace_);
    }
    pace_ = (1.0f - media_.back().phase().g()) / (1.0f - g);
}

int Schedule::order(int n) const { return static_cast<int>(exact_order(n)); }

float Schedule::exact_order(int n) const {
    const auto last = static_cast<int>(order_.size()) - 1;
    return n <= last ? order_[static_cast<std::size_t>(n)]
                     : order_.back() + pace_ * static_cast<float>(n - last);
}

// Searched for, not counted: a path may have a million events.
int Schedule::events(int orders) const {
    const std::ranges::iota_view events(1, std::max(1, orders));
    const auto below = [&](int n) { return exact_order(n) < static_cast<float>(orders); };
    return *std::ranges::partition_point(events, below);
}

}  // namespace pileus
