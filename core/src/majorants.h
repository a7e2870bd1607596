// The majorants along a ray: a hierarchical DDA over a BrickTree's cells (Museth 2014), restarted
// from the root at each step, which three levels make as cheap as keeping a stack.
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
            forward_[axis] = inverse_[axis] > 0.0f;
            const float to_low =
                (static_cast<float>(tree.low()[axis]) - ray.origin[axis]) * inverse_[axis];
            const float to_high =
                (static_cast<float>(tree.high()[axis]) - ray.origin[axis]) * inverse_[axis];
            enter = std::max(enter, std::min(to_low, to_high));
            leave = std::min(leave, std::max(to_low, to_high));
        }
        if (!(enter < leave)) return;
        t_ = enter;
        end_ = leave;
        const V3f start = ray.at(enter);
        for (int axis = 0; axis < 3; ++axis) {
            cell_[axis] = std::clamp(BrickTree::floor_int(start[axis]), tree.low()[axis],
                                     tree.high()[axis] - 1);
        }
        inside_ = true;
    }

    /// The next stretch that may hold anything. False where there is none.
    bool next(MajorantSegment& segment) {
        while (inside_) {
            const BrickTree::Cells cells = tree_->cells(cell_);
            const float begin = t_;
            step_out_of(cells);
            if (cells.majorant > 0.0f && t_ > begin) {
                segment = {begin, t_, cells.majorant};
                return true;
            }
        }
        return false;
    }

  private:
    void step_out_of(const BrickTree::Cells& cells) {
        float nearest = std::numeric_limits<float>::infinity();
        int exit = 0;
        for (int axis = 0; axis < 3; ++axis) {
            const int face = forward_[axis] ? cells.low[axis] + cells.size : cells.low[axis];
            const float t = (static_cast<float>(face) - ray_.origin[axis]) * inverse_[axis];
            if (t < nearest) {
                nearest = t;
                exit = axis;
            }
        }
        if (!(nearest < end_)) {
            t_ = end_;
            inside_ = false;
            return;
        }
        t_ = std::max(t_, nearest);
        const V3f p = ray_.at(t_);
        for (int axis = 0; axis < 3; ++axis) {
            // The exit face is known exactly; along the other axes rounding must not leave the
            // cells.
            cell_[axis] =
                axis == exit ? (forward_[axis] ? cells.low[axis] + cells.size : cells.low[axis] - 1)
                             : std::clamp(BrickTree::floor_int(p[axis]), cells.low[axis],
                                          cells.low[axis] + cells.size - 1);
        }
        inside_ = cell_[exit] >= tree_->low()[exit] && cell_[exit] < tree_->high()[exit];
    }

    const BrickTree* tree_;
    LocalRay ray_;
    V3f inverse_{0.0f};
    bool forward_[3] = {};
    V3i cell_{0};
    float t_ = 0.0f, end_ = 0.0f;
    bool inside_ = false;
};

}  // namespace pileus
