// One routine, compiled for each width of register that a machine may have; the widest is chosen
// when the program runs.
#include "tracker.h"

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstddef>
#include <cstring>
#include <span>

#if defined(__x86_64__)
#include <immintrin.h>
#endif

// Vectors pass between inlined functions alone, so nothing hangs on how they would be passed.
#pragma GCC diagnostic ignored "-Wpsabi"

namespace pileus {

namespace {

constexpr int brick_width = BrickTree::width;

namespace lanes_4 {
constexpr int width = 4;
#define PILEUS_LANES 4
#include "tracker_lanes.inc"
#undef PILEUS_LANES
}  // namespace lanes_4

#if defined(__x86_64__)
#pragma GCC push_options
#pragma GCC target("avx2")
namespace lanes_8 {
constexpr int width = 8;
#define PILEUS_LANES 8
#include "tracker_lanes.inc"
#undef PILEUS_LANES
}  // namespace lanes_8
#pragma GCC pop_options

#pragma GCC push_options
#pragma GCC target("avx512f,avx512bw,avx512dq,avx512vl")
namespace lanes_16 {
constexpr int width = 16;
#define PILEUS_LANES 16
#include "tracker_lanes.inc"
#undef PILEUS_LANES
}  // namespace lanes_16
#pragma GCC pop_options
#endif

/// Whether every index into the tree's tables fits 32 bits, as the gathers of wide machines take
/// it.
bool is_small(const BrickTree& tree) {
    constexpr std::size_t most = std::size_t{1} << 31;
    return tree.brick_count() * BrickTree::entries < most &&
           tree.node_count() * (sizeof(BrickTree::Node) / 2) < most;
}

}  // namespace

std::vector<int> Tracker::widths() {
    std::vector<int> found{4};
#if defined(__x86_64__)
    if (__builtin_cpu_supports("avx2")) found.push_back(8);
    if (__builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512bw") &&
        __builtin_cpu_supports("avx512vl"))
        found.push_back(16);
#endif
    return found;
}

Tracker::Tracker(const BrickTree& tree, Boxes boxes, int width)
    : tree_(&tree), boxes_(boxes), follow_(lanes_4::follow) {
#if defined(__x86_64__)
    if (width == 8 && is_small(tree)) follow_ = lanes_8::follow;
    if (width == 16 && is_small(tree)) follow_ = lanes_16::follow;
#endif
}

void Tracker::run() {
    for (std::size_t i = 0; i < waiting_.size(); ++i) {
        // Those that turn lie side by side, so that they turn together.
        waiting_[i].insert(waiting_[i].begin(), turning_[i].begin(), turning_[i].end());
        turning_[i].clear();
        if (waiting_[i].empty()) continue;
        follow_(static_cast<Estimator>(i), *tree_, boxes_, waiting_[i]);
        waiting_[i].clear();
    }
}

}  // namespace pileus
