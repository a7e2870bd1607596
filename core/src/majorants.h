// The majorants along a ray: a hierarchical DDA over a BrickTree (Amanatides & Woo 1987; Museth
// 2014). Among bricks it steps from one to the next with one addition and one comparison an axis;
// boxes that the tree does not divide are crossed in one step.
#pragma once

#include "brick_tree.h"

#include <algorithm>
#include <cmath>
#include <limits>

namespace pileus {

/// A ray in a tree's local coordinates. The direction is the world's, transformed but not
/// normalized: t stays the distance in world units.
struct LocalRay {
    V3f origin;
    V3f direction;
    V3f at(float t) const { return origin + direction * t; }
};

/// A stretch [begin, end) of a ray with one majorant of the interpolated density.
struct MajorantSegment {
    float begin, end, majorant;
};

/// Three axes and a spare lane, for arithmetic on all at once (GCC's and Clang's vectors).
using Floats4 = float __attribute__((vector_size(16)));
using Ints4 = int __attribute__((vector_size(16)));

class MajorantIterator {
  public:
    /// From the ray's origin onward, or from where it enters the tree.
    MajorantIterator(const BrickTree& tree, const LocalRay& ray) : tree_(&tree), ray_(ray) {
        if (tree.empty()) return;
        float enter = 0.0f, leave = std::numeric_limits<float>::infinity();
        for (int axis = 0; axis < 3; ++axis) {
            const float d = ray.direction[axis];
            origin_[axis] = ray.origin[axis];
            // A ray along the other axes takes forever to cross this one.
            inverse_[axis] = std::abs(d) > 1e-30f ? 1.0f / d : 1e30f;
            const bool forward = inverse_[axis] > 0.0f;
            step_[axis] = forward ? width : -width;
            ahead_[axis] = forward ? width : 0;
            const int low = tree.low()[axis], high = tree.high()[axis];
            enter = std::max(enter, distance(axis, forward ? low : high));
            leave = std::min(leave, distance(axis, forward ? high : low));
        }
        if (!(enter < leave)) return;
        t_ = enter;
        end_ = leave;
        inside_ = true;
        const V3f start = ray.at(enter);
        for (int axis = 0; axis < 3; ++axis) {
            brick_[axis] = brick_of(std::clamp(BrickTree::floor_int(start[axis]), tree.low()[axis],
                                               tree.high()[axis] - 1));
        }
        find_exits();
    }

    /// The next stretch that may hold anything. False where there is none.
    bool next(MajorantSegment& segment) {
        while (inside_) {
            const V3i brick(brick_[0], brick_[1], brick_[2]);
            if (!node_) {
                if (!tree_->contains(brick)) break;
                const BrickTree::Cells cells = tree_->cells(brick);
                node_ = cells.lowest;
                if (!node_) {
                    segment = {t_, 0.0f, cells.majorant};
                    step_out_of(cells);
                    segment.end = t_;
                    if (segment.majorant > 0.0f && segment.end > segment.begin) return true;
                    continue;
                }
            }
            segment.begin = t_;
            segment.majorant = tree_->majorant(*node_, brick);
            step();
            segment.end = t_;
            if (segment.majorant > 0.0f && segment.end > segment.begin) return true;
        }
        inside_ = false;
        return false;
    }

  private:
    static constexpr int width = BrickTree::width;
    static constexpr int brick_of(int cell) { return cell & ~(width - 1); }

    /// The distance along the ray to a plane across an axis.
    float distance(int axis, int plane) const {
        return (static_cast<float>(plane) - origin_[axis]) * inverse_[axis];
    }

    void find_exits() {
        exit_ = (__builtin_convertvector(brick_ + ahead_, Floats4) - origin_) * inverse_;
    }

    /// To the next brick. No lane is chosen by a branch: which axis comes next cannot be foretold.
    void step() {
        const Floats4 swapped = __builtin_shufflevector(exit_, exit_, 1, 0, 3, 2);
        const Floats4 pairs = exit_ < swapped ? exit_ : swapped;
        const Floats4 turned = __builtin_shufflevector(pairs, pairs, 2, 3, 0, 1);
        const Floats4 nearest = pairs < turned ? pairs : turned;
        t_ = std::max(t_, nearest[0]);
        if (!(t_ < end_)) {
            t_ = end_;
            inside_ = false;
            return;
        }
        const Ints4 left = brick_;
        brick_ += step_ & (exit_ <= nearest);
        find_exits();
        const Ints4 beyond = (left ^ brick_) & ~(width * width - 1);
        if (beyond[0] | beyond[1] | beyond[2]) node_ = nullptr;
    }

    /// To the first brick beyond a larger box.
    void step_out_of(const BrickTree::Cells& cells) {
        float nearest = std::numeric_limits<float>::infinity();
        int exit = 0;
        for (int axis = 0; axis < 3; ++axis) {
            const float t = distance(axis, cells.low[axis] + (ahead_[axis] ? cells.size : 0));
            if (t < nearest) {
                nearest = t;
                exit = axis;
            }
        }
        t_ = std::max(t_, nearest);
        if (!(t_ < end_)) {
            t_ = end_;
            inside_ = false;
            return;
        }
        const V3f p = ray_.at(t_);
        for (int axis = 0; axis < 3; ++axis) {
            // The exit face is known exactly; along the other axes rounding must not leave the box.
            const int cell = axis == exit
                                 ? cells.low[axis] + (ahead_[axis] ? cells.size : -1)
                                 : std::clamp(BrickTree::floor_int(p[axis]), cells.low[axis],
                                              cells.low[axis] + cells.size - 1);
            brick_[axis] = brick_of(cell);
        }
        find_exits();
    }

    const BrickTree* tree_;
    LocalRay ray_;
    // The spare lane's exit is never reached.
    Floats4 origin_{0.0f, 0.0f, 0.0f, -1.0f};
    Floats4 inverse_{0.0f, 0.0f, 0.0f, std::numeric_limits<float>::infinity()};
    Ints4 step_{}, ahead_{};  // to the next brick, and from a brick's low to its far side
    Ints4 brick_{};           // the low corner of the brick that comes next
    Floats4 exit_{};          // where the ray leaves it, across each axis
    const BrickTree::Node* node_ = nullptr;  // the lowest node around it, once known
    float t_ = 0.0f, end_ = 0.0f;
    bool inside_ = false;
};

}  // namespace pileus
