#include "brick_tree_builder.h"

#include <tbb/blocked_range.h>
#include <tbb/parallel_for.h>
#include <tbb/parallel_reduce.h>

#include <cmath>
#include <string>

// Compiled for the baseline and, where the compiler can dispatch at load time, for AVX2.
#if defined(__x86_64__) && defined(__GNUC__) && !defined(__SANITIZE_THREAD__)
#define PILEUS_DISPATCH __attribute__((target_clones("avx2", "default")))
#else
#define PILEUS_DISPATCH
#endif

namespace pileus {

namespace {

using openvdb::Coord;
using openvdb::CoordBBox;

V3i to_v3i(const Coord& c) { return {c.x(), c.y(), c.z()}; }

/// The bits of a density as the renderer takes it: what it cannot be becomes zero. Positive floats
/// order like their bits, so this and what follows is integer arithmetic that vectorizes on any
/// machine.
constexpr std::int32_t density_bits(float value) {
    constexpr std::int32_t infinity = 0x7f800000;
    const auto bits = std::bit_cast<std::int32_t>(value);
    return bits > 0 && bits < infinity ? bits : 0;
}

struct Scan {
    std::int32_t max = 0;  // bits of the greatest density
    bool odd = false;      // whether there is a NaN, infinite or negative value
};

template <class Value>
PILEUS_DISPATCH Scan scan(const Value* values, int count) {
    constexpr std::int32_t infinity = 0x7f800000;
    std::int32_t max = 0, odd = 0;
    for (int i = 0; i < count; ++i) {
        const auto value = static_cast<float>(values[i]);
        const std::int32_t density = density_bits(value);
        max = density > max ? density : max;
        const auto bits = std::bit_cast<std::int32_t>(value);
        odd |= (bits < 0 || bits >= infinity) ? 1 : 0;
    }
    return {max, odd != 0};
}

/// Halves of densities / scale. Two factors, for 2^-112 / scale may be too small for a float.
template <class Value>
PILEUS_DISPATCH void encode(const Value* values, int count, float inverse_scale, Half* halves) {
    for (int i = 0; i < count; ++i) {
        const float density = std::bit_cast<float>(density_bits(static_cast<float>(values[i])));
        const auto bits = std::bit_cast<std::uint32_t>(density * inverse_scale * 0x1p-112f);
        halves[i] = static_cast<Half>((bits + 0xfffu + ((bits >> 13) & 1u)) >> 13);
    }
}

/// A leaf's voxels as they are stored, but for those of the background, which are not: one that is
/// not zero would fill all space, and a density that is not zero there is not one.
template <class Leaf>
class StoredValues {
  public:
    using Value = typename Leaf::ValueType;

    StoredValues(const Leaf& leaf, Value background) : values_(leaf.buffer().data()) {
        if (background == Value(0)) return;
        for (openvdb::Index i = 0; i < Leaf::SIZE; ++i) {
            const bool stored = leaf.isValueOn(i) || values_[i] != background;
            cleared_[i] = stored ? values_[i] : Value(0);
        }
        values_ = cleared_.data();
    }
    StoredValues(const StoredValues&) = delete;
    StoredValues& operator=(const StoredValues&) = delete;

    const Value* data() const { return values_; }

  private:
    const Value* values_;
    std::array<Value, Leaf::SIZE> cleared_;
};

template <class Value>
void count(Value value, std::int64_t times, Census& census) {
    if (std::isnan(value)) {
        census.nan += times;
    } else if (std::isinf(static_cast<float>(value))) {
        census.infinite += times;
    } else if (value < Value(0)) {
        census.negative += times;
    }
}

/// The greatest of a brick's voxels over each of its low sides: element m covers the voxels whose
/// coordinate is 0 along every axis whose bit (4 = x, 2 = y, 1 = z) is set in m; element 0 covers
/// them all.
using Sides = std::array<Half, 8>;

/// The greatest of `rows` rows of 8 voxels, each `step` apart, the rows `pitch` apart.
template <int rows, int pitch, int step>
Half greatest_of_rows(const Half* voxels) {
    Half greatest = 0;
    for (int row = 0; row < rows; ++row) {
        for (int i = 0; i < 8; ++i) greatest = std::max(greatest, voxels[row * pitch + i * step]);
    }
    return greatest;
}

PILEUS_DISPATCH Sides sides_of(const Half* voxels) {
    return {greatest_of_rows<64, 8, 1>(voxels), greatest_of_rows<8, 64, 8>(voxels),
            greatest_of_rows<8, 64, 1>(voxels), greatest_of_rows<1, 0, 64>(voxels),
            greatest_of_rows<8, 8, 1>(voxels),  greatest_of_rows<1, 0, 8>(voxels),
            greatest_of_rows<1, 0, 1>(voxels),  voxels[0]};
}

struct Tile {
    CoordBBox box;
    float density;
};

}  // namespace

/// Fills the private parts of a tree whose size is known.
class BrickTreeBuilder {
  public:
    BrickTreeBuilder(int levels, std::size_t brick_count) {
        tree_.levels_ = levels;
        tree_.extent_ = 1 << (BrickTree::log2_width * (levels + 1));
        tree_.bricks_ = std::make_unique_for_overwrite<BrickTree::Brick[]>(brick_count + 1);
        tree_.brick_count_ = brick_count;
        sides_.resize(brick_count);
        add_node(levels, V3i(0), BrickTree::constant(0));
    }

    void set_scale(float scale) { tree_.scale_ = scale; }
    float scale() const { return tree_.scale_; }

    BrickTree::Brick& brick(std::size_t number) { return tree_.bricks_[number]; }
    void measure(std::size_t number) { sides_[number] = sides_of(tree_.bricks_[number].data()); }

    /// Hangs a measured brick into the tree.
    void insert(std::size_t number, const V3i& low) {
        Node& node = tree_.nodes_[lowest_node(low)];
        node.child[BrickTree::entry(low, BrickTree::log2_width)] = static_cast<Child>(number);
        // The cells just below a side with something on it see that side, so they need
        // majorants of their own.
        for (unsigned m = 1; m < 8; ++m) {
            if (sides_[number][m] > 0) lowest_node(low - side_offset(m));
        }
    }

    /// Gives the 8-aligned box [low, high) one value. Its interior may stay coarse; the cells that
    /// touch other values, on its high side and just below its low side, get nodes of the finest
    /// level.
    void fill(const V3i& low, const V3i& high, Half value) {
        constexpr int w = BrickTree::width;
        fill(0, low, high - V3i(w), value);
        for (int x = low.x - w; x < high.x; x += w) {
            for (int y = low.y - w; y < high.y; y += w) {
                for (int z = low.z - w; z < high.z; z += w) {
                    const bool below = x < low.x || y < low.y || z < low.z;
                    const bool shell = x == high.x - w || y == high.y - w || z == high.z - w;
                    if (!below && !shell) {
                        z = std::max(z, high.z - 2 * w);
                        continue;
                    }
                    Node& node = tree_.nodes_[lowest_node(V3i(x, y, z))];
                    if (!below)
                        node.child[BrickTree::entry(V3i(x, y, z), BrickTree::log2_width)] =
                            BrickTree::constant(value);
                }
            }
        }
    }

    /// Computes all majorants, and gives the tree away.
    BrickTree finish(const V3i& low, const V3i& high) {
        using NodeRange = tbb::blocked_range<std::size_t>;
        tbb::parallel_for(NodeRange(0, tree_.nodes_.size()), [&](const NodeRange& range) {
            for (std::size_t n = range.begin(); n != range.end(); ++n) {
                if (level_[n] == 1) bound_lowest(n);
            }
        });
        // A node comes before its children, so backwards each finds them done.
        for (std::size_t n = tree_.nodes_.size(); n-- > 0;) {
            if (level_[n] > 1) bound_inner(n);
        }
        tree_.max_ = tree_.scale_ * decode_half(greatest(0));
        tree_.low_ = low;
        tree_.high_ = high;
        tree_.nodes_.shrink_to_fit();
        return std::move(tree_);
    }

  private:
    using Node = BrickTree::Node;
    using Child = BrickTree::Child;

    static V3i side_offset(unsigned m) {
        constexpr int w = BrickTree::width;
        return {m & 4 ? w : 0, m & 2 ? w : 0, m & 1 ? w : 0};
    }

    Child add_node(int level, const V3i& low, Child children) {
        Node& node = tree_.nodes_.emplace_back();
        node.child.fill(children);
        level_.push_back(static_cast<std::uint8_t>(level));
        low_.push_back(low);
        return static_cast<Child>(tree_.nodes_.size() - 1);
    }

    /// The node behind an entry, made where there was only a constant.
    std::size_t child_node(std::size_t parent, unsigned entry, const V3i& low) {
        const Child child = tree_.nodes_[parent].child[entry];
        if (!(child & BrickTree::constant_bit)) return child;
        const Child made = add_node(level_[parent] - 1, low, child);
        tree_.nodes_[parent].child[entry] = made;
        return made;
    }

    std::size_t lowest_node(const V3i& at) {
        std::size_t node = 0;
        for (int level = tree_.levels_; level > 1; --level) {
            const int shift = BrickTree::log2_width * level;
            const int mask = ~((1 << shift) - 1);
            node = child_node(node, BrickTree::entry(at, shift),
                              V3i(at.x & mask, at.y & mask, at.z & mask));
        }
        return node;
    }

    void fill(std::size_t n, const V3i& low, const V3i& high, Half value) {
        if (low.x >= high.x || low.y >= high.y || low.z >= high.z) return;
        const int shift = BrickTree::log2_width * level_[n];
        const int size = 1 << shift;
        const V3i corner = low_[n];
        const auto first = [&](int a, int c) { return std::max(a, c) & ~(size - 1); };
        const auto last = [&](int b, int c) { return std::min(b, c + size * BrickTree::width); };
        for (int x = first(low.x, corner.x); x < last(high.x, corner.x); x += size) {
            for (int y = first(low.y, corner.y); y < last(high.y, corner.y); y += size) {
                for (int z = first(low.z, corner.z); z < last(high.z, corner.z); z += size) {
                    const V3i child_low(x, y, z);
                    const unsigned entry = BrickTree::entry(child_low, shift);
                    const bool covered = x >= low.x && y >= low.y && z >= low.z &&
                                         x + size <= high.x && y + size <= high.y &&
                                         z + size <= high.z;
                    if (covered) {
                        tree_.nodes_[n].child[entry] = BrickTree::constant(value);
                    } else {
                        fill(child_node(n, entry, child_low), low, high, value);
                    }
                }
            }
        }
    }

    void bound_lowest(std::size_t n) {
        constexpr int w = BrickTree::width;
        Node& node = tree_.nodes_[n];
        for (int i = 0; i < BrickTree::entries; ++i) {
            const V3i low = low_[n] + V3i((i >> 6) * w, (i >> 3 & 7) * w, (i & 7) * w);
            Half greatest = 0;
            for (unsigned m = 0; m < 8; ++m) {
                const V3i at = low + side_offset(m);
                const Child found = tree_.contains(at) ? tree_.descend(at) : BrickTree::constant(0);
                greatest =
                    std::max(greatest, found & BrickTree::constant_bit ? static_cast<Half>(found)
                                                                       : sides_[found][m]);
            }
            node.max[static_cast<unsigned>(i)] = greatest;
        }
        constexpr unsigned even = 0666;  // octal: the first of eight children, an axis a digit
        node.eight_max.fill(0);
        for (unsigned i = 0; i < BrickTree::entries; ++i)
            node.eight_max[i & even] = std::max(node.eight_max[i & even], node.max[i]);
        for (unsigned i = 0; i < BrickTree::entries; ++i)
            node.eight_max[i] = node.eight_max[i & even];
    }

    void bound_inner(std::size_t n) {
        Node& node = tree_.nodes_[n];
        for (unsigned i = 0; i < BrickTree::entries; ++i) {
            const Child child = node.child[i];
            node.max[i] =
                child & BrickTree::constant_bit ? static_cast<Half>(child) : greatest(child);
        }
    }

    Half greatest(std::size_t n) const {
        const auto& all = tree_.nodes_[n].max;
        return *std::max_element(all.begin(), all.end());
    }

    BrickTree tree_;
    std::vector<Sides> sides_;         // of each brick
    std::vector<std::uint8_t> level_;  // of each node
    std::vector<V3i> low_;             // of each node
};

namespace {

/// Tiles above the leaves that hold something.
template <class Tree>
auto collect_tiles(const Tree& tree, Census& census) {
    std::vector<Tile> tiles;
    auto it = tree.cbeginValueAll();
    it.setMaxDepth(Tree::ValueAllCIter::LEAF_DEPTH - 1);
    for (; it; ++it) {
        if (it.isValueOn()) count(*it, static_cast<std::int64_t>(it.getVoxelCount()), census);
        const std::int32_t bits = density_bits(static_cast<float>(*it));
        if (bits == 0 || (!it.isValueOn() && *it == tree.background())) continue;
        CoordBBox box;
        it.getBoundingBox(box);
        tiles.push_back({box, std::bit_cast<float>(bits)});
    }
    return tiles;
}

template <class Tree>
BuiltTree build(const Tree& tree) {
    using Leaf = typename Tree::LeafNodeType;
    using LeafRange = tbb::blocked_range<std::size_t>;
    static_assert(Leaf::DIM == BrickTree::width);

    BuiltTree built;
    const auto tiles = collect_tiles(tree, built.census);
    std::vector<const Leaf*> leaves;
    tree.getNodes(leaves);

    // The first pass reads what OpenVDB left on disk, counts, and finds what is there at all.
    std::vector<std::int32_t> greatest(leaves.size());
    built.census += tbb::parallel_reduce(
        LeafRange(0, leaves.size()), Census{},
        [&](const LeafRange& range, Census census) {
            for (std::size_t l = range.begin(); l != range.end(); ++l) {
                const StoredValues values(*leaves[l], tree.background());
                const Scan found = scan(values.data(), Leaf::SIZE);
                greatest[l] = found.max;
                if (!found.odd) continue;
                for (auto it = leaves[l]->cbeginValueOn(); it; ++it) count(*it, 1, census);
            }
            return census;
        },
        [](Census a, const Census& b) { return a += b; });

    float max = 0.0f;
    CoordBBox box;
    std::size_t kept = 0;
    for (std::size_t l = 0; l < leaves.size(); ++l) {
        if (greatest[l] == 0) continue;
        max = std::max(max, std::bit_cast<float>(greatest[l]));
        box.expand(leaves[l]->getNodeBoundingBox());
        leaves[kept++] = leaves[l];
    }
    leaves.resize(kept);
    for (const auto& tile : tiles) {
        max = std::max(max, tile.density);
        box.expand(tile.box);
    }
    if (box.empty()) return built;

    // One brick of margin below: the cells there interpolate towards the first voxels.
    built.origin = to_v3i(box.min()) - V3i(BrickTree::width);
    std::int64_t extent = 0;
    for (int axis = 0; axis < 3; ++axis) {
        extent = std::max(extent, std::int64_t{box.max()[axis]} + 1 - built.origin[axis]);
    }
    if (extent > widest_extent) {
        throw TooWide("spans " + std::to_string(extent) + " voxels; at most " +
                      std::to_string(widest_extent) + " can be resolved");
    }
    int levels = 1;
    while ((std::int64_t{1} << (BrickTree::log2_width * (levels + 1))) < extent) ++levels;

    BrickTreeBuilder builder(levels, leaves.size());
    // The greatest value lands in the upper half of the halves' range: small ones keep their
    // precision.
    builder.set_scale(std::ldexp(1.0f, std::max(std::ilogb(max) - 14, -100)));
    const float inverse_scale = 1.0f / builder.scale();
    tbb::parallel_for(LeafRange(0, leaves.size()), [&](const LeafRange& range) {
        for (std::size_t l = range.begin(); l != range.end(); ++l) {
            const StoredValues values(*leaves[l], tree.background());
            encode(values.data(), Leaf::SIZE, inverse_scale, builder.brick(l).data());
            builder.measure(l);
        }
    });
    const auto local = [&](const Coord& c) { return to_v3i(c) - built.origin; };
    for (const auto& tile : tiles) {
        builder.fill(local(tile.box.min()), local(tile.box.max().offsetBy(1)),
                     encode_half(tile.density * inverse_scale));
    }
    for (std::size_t l = 0; l < leaves.size(); ++l) builder.insert(l, local(leaves[l]->origin()));
    built.tree = builder.finish(local(box.min()) - V3i(1), local(box.max()) + V3i(1));
    return built;
}

}  // namespace

BuiltTree build_brick_tree(const openvdb::FloatTree& tree) { return build(tree); }
BuiltTree build_brick_tree(const openvdb::DoubleTree& tree) { return build(tree); }

}  // namespace pileus
