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

/// A stretch [begin, end) of a ray with one majorant of the interpolated density, and the brick
/// that it lies in, where it is one.
struct MajorantSegment {
    float begin, end, majorant;
    BrickTree::Cursor brick;
};

class MajorantIterator {
  public:
    /// From the ray's origin onward, or from where it enters the tree.
    MajorantIterator(const BrickTree& tree, const LocalRay& ray) : tree_(&tree), ray_(ray) {
        if (tree.empty()) return;
        float enter = 0.0f, leave = std::numeric_limits<float>::infinity();
        for (int axis = 0; axis < 3; ++axis) {
            const float d = ray.direction[axis];
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
            exit_[axis] = distance(axis, brick_[axis] + ahead_[axis]);
        }
    }

    /// The next stretch that may hold anything. False where there is none.
    bool next(MajorantSegment& segment) {
        while (inside_) {
            if (!node_) {
                const BrickTree::Cells cells = tree_->cells(brick_);
                node_ = cells.lowest;
                if (!node_) {
                    segment = {t_, 0.0f, cells.majorant, {}};
                    step_out_of(cells);
                    segment.end = t_;
                    if (segment.majorant > 0.0f && segment.end > segment.begin) return true;
                    continue;
                }
            }
            segment = {t_,
                       0.0f,
                       tree_->majorant(*node_, brick_),
                       {brick_, BrickTree::child(*node_, brick_)}};
            step();
            segment.end = t_;
            if (segment.majorant > 0.0f && segment.end > segment.begin) return true;
        }
        return false;
    }

  private:
    static constexpr int width = BrickTree::width;
    static constexpr int brick_of(int cell) { return cell & ~(width - 1); }

    /// The distance along the ray to a plane across an axis.
    float distance(int axis, int plane) const {
        return (static_cast<float>(plane) - ray_.origin[axis]) * inverse_[axis];
    }

    /// To the next brick.
    void step() {
        int axis = exit_[1] < exit_[0] ? 1 : 0;
        axis = exit_[2] < exit_[axis] ? 2 : axis;
        t_ = std::max(t_, exit_[axis]);
        if (!(t_ < end_)) {
            t_ = end_;
            inside_ = false;
            return;
        }
        const int left = brick_[axis];
        brick_[axis] = left + step_[axis];
        exit_[axis] = distance(axis, brick_[axis] + ahead_[axis]);
        if ((left ^ brick_[axis]) & ~(width * width - 1)) node_ = nullptr;
        inside_ = brick_[axis] >= 0 && brick_[axis] < tree_->extent();
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
            exit_[axis] = distance(axis, brick_[axis] + ahead_[axis]);
        }
        inside_ = brick_[exit] >= 0 && brick_[exit] < tree_->extent();
    }

    const BrickTree* tree_;
    LocalRay ray_;
    V3f inverse_{0.0f};
    V3i step_{0}, ahead_{0};  // to the next brick, and from a brick's low to its far side
    V3i brick_{0};            // the low corner of the brick that comes next
    V3f exit_{0.0f};          // where the ray leaves it, across each axis
    const BrickTree::Node* node_ = nullptr;  // the lowest node around it, once known
    float t_ = 0.0f, end_ = 0.0f;
    bool inside_ = false;
};

}  // namespace pileus
