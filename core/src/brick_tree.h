// The sampling structure: 8^3 bricks of half floats under nodes of 8^3 children, as many levels of
// nodes as the grid is wide. Each child carries the exact majorant of the trilinearly interpolated
// field over its cells, so that a ray crosses empty space in a few steps and every majorant is
// local (after Museth 2013, whose tree it is built from, and the hierarchical DDA of Museth 2014).
#pragma once

#include "geometry.h"

#include <array>
#include <bit>
#include <cstdint>
#include <limits>
#include <memory>
#include <vector>

namespace pileus {

/// A non-negative half float. Decoded with integer arithmetic alone: no F16C is needed.
using Half = std::uint16_t;

/// The half's bits moved into a float's place are the value times 2^-112.
constexpr float decode_half(Half h) {
    return std::bit_cast<float>(static_cast<std::uint32_t>(h) << 13) * 0x1p112f;
}

/// Rounds a value in [0, 65504] to the nearest half, ties to even.
constexpr Half encode_half(float value) {
    const auto bits = std::bit_cast<std::uint32_t>(value * 0x1p-112f);
    return static_cast<Half>((bits + 0xfffu + ((bits >> 13) & 1u)) >> 13);
}

/// What a ray crosses at a time where the tree is finest: a brick, or eight of them.
enum class Boxes { bricks, eights };

/// A sparse field of non-negative values at integer coordinates, zero where nothing is stored.
/// Coordinates are local: they start at (0, 0, 0) in the corner of the root.
class BrickTree {
  public:
    static constexpr int log2_width = 3;
    static constexpr int width = 1 << log2_width;
    static constexpr int entries = width * width * width;

    using Brick = std::array<Half, entries>;

    /// A child is a brick or node by number, or, with the top bit set, one value throughout.
    using Child = std::uint32_t;
    static constexpr Child constant_bit = 0x80000000u;
    static constexpr Child constant(Half value) { return constant_bit | value; }

    struct Node {
        std::array<Child, entries> child;
        std::array<Half, entries> max;        // over a child's cells
        std::array<Half, entries> eight_max;  // over those of the 2^3, aligned, that it is one of
    };

    /// The largest box of cells around a point on which the tree has one majorant to offer.
    struct Cells {
        V3i low;
        int size;
        float majorant;
        const Node* lowest;  // the node of the bricks here; null where the cells are a coarser box
    };

    BrickTree() = default;

    bool empty() const { return nodes_.empty(); }

    /// Cells across the root, in each dimension.
    int extent() const { return extent_; }

    /// The least and greatest cell that holds anything, local coordinates: [low, high).
    const V3i& low() const { return low_; }
    const V3i& high() const { return high_; }

    /// The greatest value of all.
    float max() const { return max_; }

    std::size_t bytes() const {
        return nodes_.capacity() * sizeof(Node) + brick_count_ * sizeof(Brick);
    }

    bool contains(const V3i& cell) const {
        const auto limit = static_cast<unsigned>(extent_);
        return static_cast<unsigned>(cell.x) < limit && static_cast<unsigned>(cell.y) < limit &&
               static_cast<unsigned>(cell.z) < limit;
    }

    /// The value at integer coordinates.
    float voxel(const V3i& at) const {
        if (!contains(at)) return 0.0f;
        return value(descend(at), at);
    }

    /// The brick or constant that was read last: points that follow each other mostly share it.
    struct Cursor {
        V3i low{std::numeric_limits<int>::min()};
        Child found = constant_bit;
    };

    /// The field at x, interpolated trilinearly between the eight voxels around it.
    float interpolate(const V3f& x, Cursor& cursor) const;
    float interpolate(const V3f& x) const {
        Cursor cursor;
        return interpolate(x, cursor);
    }

    static constexpr int width_of(Boxes boxes) {
        return boxes == Boxes::bricks ? width : 2 * width;
    }

    /// The cells around one cell inside the root, with the majorant of the field over them.
    Cells cells(const V3i& cell, Boxes boxes = Boxes::bricks) const {
        const Node* node = &nodes_[0];
        for (int level = levels_;; --level) {
            const int shift = log2_width * level;
            const unsigned e = entry(cell, shift);
            const Child child = node->child[e];
            const Half majorant = node->max[e];
            const auto box = [&](int size, Half most, const Node* lowest) {
                return Cells{V3i(cell.x & -size, cell.y & -size, cell.z & -size), size,
                             scale_ * decode_half(most), lowest};
            };
            if (level == 1)
                return box(width_of(boxes), boxes == Boxes::bricks ? majorant : node->eight_max[e],
                           node);
            if (majorant == 0 || (child & constant_bit)) return box(1 << shift, majorant, nullptr);
            node = &nodes_[child];
        }
    }

    /// The majorant over the cells of a brick, by one of the node's own voxels in it.
    float majorant(const Node& lowest, const V3i& cell) const {
        return scale_ * decode_half(lowest.max[entry(cell, log2_width)]);
    }

    static int floor_int(float x) {
        const int truncated = static_cast<int>(x);
        return truncated - (static_cast<float>(truncated) > x);
    }

    // For who follows many rays at once: what the functions above read, as it lies in memory. After
    // the last brick there is room for another.
    const Node* nodes() const { return nodes_.data(); }
    const Brick* bricks() const { return bricks_.get(); }
    std::size_t node_count() const { return nodes_.size(); }
    std::size_t brick_count() const { return brick_count_; }
    float scale() const { return scale_; }
    int levels() const { return levels_; }

    /// The brick or constant that holds a voxel inside the root.
    Child descend(const V3i& at) const {
        Child child = 0;
        for (int level = levels_; level > 0; --level) {
            child = nodes_[child].child[entry(at, log2_width * level)];
            if (child & constant_bit) break;
        }
        return child;
    }

  private:
    friend class BrickTreeBuilder;

    static constexpr unsigned entry(const V3i& at, int shift) {
        constexpr int mask = width - 1;
        return static_cast<unsigned>((((at.x >> shift) & mask) << (2 * log2_width)) |
                                     (((at.y >> shift) & mask) << log2_width) |
                                     ((at.z >> shift) & mask));
    }

    float value(Child found, const V3i& at) const {
        return scale_ * decode_half(found & constant_bit ? static_cast<Half>(found)
                                                         : bricks_[found][entry(at, 0)]);
    }

    std::vector<Node> nodes_;  // the root first
    std::unique_ptr<Brick[]> bricks_;
    std::size_t brick_count_ = 0;
    int levels_ = 0;  // of nodes; a child at level l is width^l cells wide
    int extent_ = 0;
    float scale_ = 1.0f;  // a power of two: halves hold value / scale
    V3i low_{0}, high_{0};
    float max_ = 0.0f;
};

}  // namespace pileus
