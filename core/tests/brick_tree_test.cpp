// The sampling structure against OpenVDB and against brute force: interpolation, exact bounds,
// tiles, odd values, and the majorants along rays of every awkward kind.
#include "brick_tree_builder.h"
#include "majorants.h"
#include "random.h"
#include "support.h"

#include <openvdb/tools/Interpolation.h>

#include <cmath>
#include <gtest/gtest.h>
#include <limits>
#include <vector>

namespace pileus {
namespace {

using openvdb::Coord;
using openvdb::CoordBBox;
using openvdb::FloatGrid;

constexpr float infinity = std::numeric_limits<float>::infinity();

FloatGrid::Ptr empty_grid() {
    openvdb::initialize();
    return FloatGrid::create(0.0f);
}

int draw(Random& random, int below) { return static_cast<int>(random.bits() % unsigned(below)); }

/// Clumps of random voxels, lone voxels, inactive values and tiles of 8^3 that touch each other and
/// nothing, on both sides of the origin.
FloatGrid::Ptr random_sparse_grid(std::uint64_t key) {
    const auto grid = empty_grid();
    Random random(key);
    auto& tree = grid->tree();
    const auto corner = [&] {
        return Coord(draw(random, 120) - 60, draw(random, 120) - 60, draw(random, 120) - 60);
    };
    for (int tile = 0; tile < 12; ++tile) tree.addTile(1, corner(), random.uniform(), true);
    for (int clump = 0; clump < 6; ++clump) {
        const Coord low = corner();
        for (int i = 0; i < 600; ++i) {
            tree.setValue(low.offsetBy(draw(random, 12), draw(random, 12), draw(random, 12)),
                          0.01f + random.uniform());
        }
    }
    for (int i = 0; i < 40; ++i) tree.setValue(corner(), 0.01f + random.uniform());
    for (int i = 0; i < 40; ++i) tree.setValueOff(corner(), 0.01f + random.uniform());
    return grid;
}

/// The field equals OpenVDB's at points around a box of the grid, to what a half can hold.
void expect_same_field(const FloatGrid& grid, const BuiltTree& built, const CoordBBox& around,
                       int points, std::uint64_t key) {
    Random random(key);
    for (int i = 0; i < points; ++i) {
        // Multiples of 1/64 have no rounding of their own.
        openvdb::Vec3d x;
        V3f local;
        for (int axis = 0; axis < 3; ++axis) {
            const int span = around.max()[axis] - around.min()[axis] + 3;
            x[axis] = around.min()[axis] - 1 + draw(random, span * 64) / 64.0;
            local[axis] = static_cast<float>(x[axis] - built.origin[axis]);
        }
        const double expected = openvdb::tools::BoxSampler::sample(grid.tree(), x);
        ASSERT_NEAR(built.tree.interpolate(local), expected, expected * 0x1p-11 + 1e-6)
            << "at " << x;
    }
}

/// The majorant of the cells around a point is the greatest voxel that they can see.
void expect_exact_majorant(const BrickTree& tree, const V3i& cell, Random& random,
                           Boxes boxes = Boxes::bricks) {
    const BrickTree::Cells cells = tree.cells(cell, boxes);
    for (int axis = 0; axis < 3; ++axis) {
        ASSERT_LE(cells.low[axis], cell[axis]);
        ASSERT_LT(cell[axis], cells.low[axis] + cells.size);
    }
    if (cells.size == BrickTree::width_of(boxes)) {
        float greatest = 0.0f;
        for (int x = 0; x <= cells.size; ++x) {
            for (int y = 0; y <= cells.size; ++y) {
                for (int z = 0; z <= cells.size; ++z) {
                    greatest = std::max(greatest, tree.voxel(cells.low + V3i(x, y, z)));
                }
            }
        }
        ASSERT_EQ(cells.majorant, greatest) << cell;
        return;
    }
    // Wider boxes are offered only where the field is constant: any voxel will do, the far faces'
    // too.
    for (int i = 0; i < 64; ++i) {
        V3i at = cells.low;
        for (int axis = 0; axis < 3; ++axis) {
            const int kind = draw(random, 4);
            at[axis] += kind == 0 ? 0 : kind == 1 ? cells.size : draw(random, cells.size + 1);
        }
        ASSERT_EQ(tree.voxel(at), cells.majorant) << at << " seen from " << cell;
    }
}

void expect_exact_majorants(const BrickTree& tree, int cells, std::uint64_t key) {
    Random random(key);
    for (int i = 0; i < cells; ++i) {
        V3i cell;
        for (int axis = 0; axis < 3; ++axis) {
            cell[axis] = tree.low()[axis] + draw(random, tree.high()[axis] - tree.low()[axis]);
        }
        for (const Boxes boxes : {Boxes::bricks, Boxes::eights})
            expect_exact_majorant(tree, cell, random, boxes);
        if (testing::Test::HasFatalFailure()) return;
    }
}

TEST(BrickTree, InterpolatesAsOpenVdbDoes) {
    for (const std::uint64_t key : {1u, 2u, 3u, 4u}) {
        const auto grid = random_sparse_grid(key);
        const BuiltTree built = build_brick_tree(grid->tree());
        CoordBBox box;
        grid->tree().evalLeafBoundingBox(box);
        expect_same_field(*grid, built, box, 200000, key);
    }
}

TEST(BrickTree, KeepsALinearFieldWhereItIs) {
    const auto grid = empty_grid();
    const auto field = [](double x, double y, double z) { return 1.0 + x + 2.0 * y + 4.0 * z; };
    for (int x = 0; x < 40; ++x) {
        for (int y = 0; y < 40; ++y) {
            for (int z = 0; z < 40; ++z) {
                // Integers up to 2048 are exact in half.
                grid->tree().setValue(Coord(x, y, z), static_cast<float>(field(x, y, z)));
            }
        }
    }
    const BuiltTree built = build_brick_tree(grid->tree());
    Random random(5);
    for (int i = 0; i < 100000; ++i) {
        const V3f x(39.0f * random.uniform(), 39.0f * random.uniform(), 39.0f * random.uniform());
        const V3f local =
            x - V3f(static_cast<float>(built.origin.x), static_cast<float>(built.origin.y),
                    static_cast<float>(built.origin.z));
        ASSERT_NEAR(built.tree.interpolate(local), field(x.x, x.y, x.z), 1e-4);
    }
}

TEST(BrickTree, MajorantsAreTheGreatestVoxelSeen) {
    for (const std::uint64_t key : {1u, 2u, 3u}) {
        const auto grid = random_sparse_grid(key);
        const BuiltTree built = build_brick_tree(grid->tree());
        expect_exact_majorants(built.tree, 4000, key);
        float greatest = 0.0f;
        for (auto it = grid->tree().cbeginValueAll(); it; ++it) greatest = std::max(greatest, *it);
        EXPECT_NEAR(built.tree.max(), greatest, greatest * 0x1p-11);
    }
}

TEST(BrickTree, AVoxelOnTheCornerOfNodesIsSeenFromAllAround) {
    // The cells below it lie in seven other nodes, which hold nothing of their own.
    for (const int corner : {56, 120, 504, 4088}) {
        const auto grid = empty_grid();
        grid->tree().setValue(Coord(0), 0.5f);  // puts the tree's origin at -8
        grid->tree().setValue(Coord(corner), 1.0f);
        const BuiltTree built = build_brick_tree(grid->tree());
        const V3i voxel = V3i(corner) - built.origin;
        ASSERT_EQ(voxel.x % 64, 0);
        Random random(1);
        for (unsigned below = 0; below < 8; ++below) {
            const V3i cell = voxel - V3i(below >> 2, below >> 1 & 1, below & 1);
            EXPECT_EQ(built.tree.cells(cell).majorant, 1.0f) << below << " of " << corner;
            expect_exact_majorant(built.tree, cell, random);
        }
    }
}

struct TileCase {
    const char* name;
    void (*fill)(FloatGrid&);
};

class TileTest : public testing::TestWithParam<TileCase> {};

TEST_P(TileTest, FieldAndMajorantsHoldAtItsFaces) {
    const auto grid = empty_grid();
    GetParam().fill(*grid);
    const BuiltTree built = build_brick_tree(grid->tree());
    CoordBBox box;
    grid->tree().evalActiveVoxelBoundingBox(box);
    expect_same_field(*grid, built, box, 20000, 1);
    expect_exact_majorants(built.tree, 2000, 2);
    // Faces, edges and corners, which random points rarely meet in a wide tile.
    Random random(3);
    for (int i = 0; i < 3000; ++i) {
        CoordBBox spot;
        V3i cell;
        for (int axis = 0; axis < 3; ++axis) {
            const int kind = draw(random, 3);
            const int span = box.max()[axis] - box.min()[axis] + 1;
            const int at = kind == 0   ? box.min()[axis]
                           : kind == 1 ? box.max()[axis]
                                       : box.min()[axis] + draw(random, span);
            spot.min()[axis] = spot.max()[axis] = at;
            cell[axis] = std::clamp(at - built.origin[axis] - draw(random, 2),
                                    built.tree.low()[axis], built.tree.high()[axis] - 1);
        }
        expect_same_field(*grid, built, spot, 4, random.bits());
        expect_exact_majorant(built.tree, cell, random);
        if (HasFatalFailure()) return;
    }
}

INSTANTIATE_TEST_SUITE_P(
    Sizes, TileTest,
    testing::Values(
        TileCase{"Width8", [](FloatGrid& g) { g.tree().addTile(1, Coord(-8, 0, 8), 0.5f, true); }},
        TileCase{"Width128", [](FloatGrid& g) { g.tree().addTile(2, Coord(0), 0.5f, true); }},
        TileCase{"Width4096", [](FloatGrid& g) { g.tree().addTile(3, Coord(0), 0.5f, true); }},
        TileCase{"Inactive",
                 [](FloatGrid& g) {
                     g.tree().addTile(2, Coord(0), 0.5f, false);
                     g.tree().setValue(Coord(-3, 5, 130), 0.7f);
                 }},
        TileCase{"BesideEachOther",
                 [](FloatGrid& g) {
                     g.tree().addTile(2, Coord(0), 0.5f, true);
                     g.tree().addTile(2, Coord(128, 0, 0), 1.0f, true);
                     g.tree().addTile(1, Coord(-8, 16, 16), 0.25f, true);
                     g.tree().addTile(1, Coord(256, 64, 120), 2.0f, true);
                 }},
        TileCase{"BesideLeaves",
                 [](FloatGrid& g) {
                     g.tree().addTile(2, Coord(0), 0.5f, true);
                     for (int i = 0; i < 128; i += 3) {
                         g.tree().setValue(Coord(i, -1, 127 - i), 1.0f);
                         g.tree().setValue(Coord(128, i, i), 0.9f);
                     }
                 }},
        TileCase{"LeavesWithin",
                 [](FloatGrid& g) {
                     g.tree().addTile(2, Coord(0), 0.5f, true);
                     g.tree().setValue(Coord(64), 0.0f);
                     g.tree().setValue(Coord(72, 63, 64), 1.0f);
                     g.tree().setValue(Coord(127), 3.0f);
                 }},
        TileCase{"Fill",
                 [](FloatGrid& g) { g.fill(CoordBBox(Coord(-9), Coord(300, 21, 140)), 0.5f); }},
        TileCase{"SparseFill",
                 [](FloatGrid& g) {
                     g.sparseFill(CoordBBox(Coord(-9), Coord(300, 21, 140)), 0.5f);
                     g.sparseFill(CoordBBox(Coord(3), Coord(131, 9, 100)), 0.75f);
                 }}),
    [](const auto& info) { return info.param.name; });

TEST(BrickTree, CountsWhatCannotBeADensityAndTakesItAsZero) {
    const auto grid = empty_grid();
    auto& tree = grid->tree();
    tree.setValue(Coord(0), 1.0f);
    tree.setValue(Coord(1, 0, 0), std::nanf(""));
    tree.setValue(Coord(2, 0, 0), infinity);
    tree.setValue(Coord(3, 0, 0), -infinity);
    tree.setValue(Coord(4, 0, 0), -1.0f);
    tree.setValue(Coord(5, 0, 0), -2.0f);
    tree.setValueOff(Coord(6, 0, 0), -2.0f);
    tree.addTile(1, Coord(16, 0, 0), -1.0f, true);
    tree.addTile(1, Coord(24, 0, 0), std::nanf(""), true);
    tree.addTile(1, Coord(32, 0, 0), infinity, true);
    const BuiltTree built = build_brick_tree(tree);
    EXPECT_EQ(built.census.nan, 1 + 512);
    EXPECT_EQ(built.census.infinite, 2 + 512);
    EXPECT_EQ(built.census.negative, 2 + 512);
    for (int x = -1; x < 40; ++x) {
        const V3i local = V3i(x, 0, 0) - built.origin;
        EXPECT_EQ(built.tree.voxel(local), x == 0 ? 1.0f : 0.0f) << x;
    }
    EXPECT_EQ(built.tree.max(), 1.0f);
}

TEST(BrickTree, OfABackgroundThatIsNotZeroOnlyWhatIsStoredIsDensity) {
    const auto grid = openvdb::FloatGrid::create(1.0f);
    auto& tree = grid->tree();
    tree.setValue(Coord(0), 1.0f);  // as the background, but stored
    tree.setValue(Coord(1, 0, 0), 0.5f);
    tree.addTile(1, Coord(16, 0, 0), 1.0f, true);
    tree.addTile(1, Coord(24, 0, 0), 1.0f, false);
    const BuiltTree built = build_brick_tree(tree);
    for (int x = -1; x < 40; ++x) {
        const float stored = x == 1 ? 0.5f : x == 0 || (x >= 16 && x < 24) ? 1.0f : 0.0f;
        EXPECT_EQ(built.tree.voxel(V3i(x, 0, 0) - built.origin), stored) << x;
    }
}

TEST(BrickTree, GridsThatHoldNothingAreEmpty) {
    const auto grid = empty_grid();
    EXPECT_TRUE(build_brick_tree(grid->tree()).tree.empty());
    grid->tree().setValue(Coord(7, 8, 9), 0.0f);
    grid->tree().setValue(Coord(100, 8, 9), -1.0f);
    const BuiltTree built = build_brick_tree(grid->tree());
    EXPECT_TRUE(built.tree.empty());
    EXPECT_EQ(built.census.negative, 1);
    MajorantSegment segment;
    MajorantIterator majorants(built.tree, {V3f(0.0f), V3f(1.0f, 0.0f, 0.0f)});
    EXPECT_FALSE(majorants.next(segment));
}

TEST(BrickTree, ALoneVoxelFarAwayIsFoundAndCheap) {
    const auto grid = empty_grid();
    const Coord far(100000, -100000, 99999);
    grid->tree().setValue(Coord(0), 1.0f);
    grid->tree().setValue(far, 0.5f);
    const BuiltTree built = build_brick_tree(grid->tree());
    expect_same_field(*grid, built, CoordBBox(far, far), 2000, 1);
    expect_same_field(*grid, built, CoordBBox(Coord(0), Coord(0)), 2000, 2);
    EXPECT_LT(built.tree.bytes(), std::size_t{1} << 20);

    // A ray from one to the other crosses the emptiness between in a few steps.
    const V3f from(V3i(0) - built.origin);
    const V3f to(V3i(far.x(), far.y(), far.z()) - built.origin);
    MajorantIterator majorants(built.tree, {from, to - from});
    MajorantSegment segment;
    int segments = 0;
    bool seen = false;
    while (majorants.next(segment)) {
        ++segments;
        seen |= segment.majorant == 0.5f && segment.begin <= 1.0f && segment.end >= 1.0f;
    }
    EXPECT_TRUE(seen);
    EXPECT_LT(segments, 20);
}

TEST(BrickTree, RefusesAGridTooWideForFloatCoordinates) {
    const auto grid = empty_grid();
    grid->tree().setValue(Coord(0), 1.0f);
    grid->tree().setValue(Coord(1 << 20, 0, 0), 1.0f);
    EXPECT_THROW(build_brick_tree(grid->tree()), TooWide);
    // The coordinates of OpenVDB's own corners: the span alone overflows an int.
    grid->tree().setValue(Coord(std::numeric_limits<int>::min() + 8, 0, 0), 1.0f);
    grid->tree().setValue(Coord(std::numeric_limits<int>::max() - 8, 0, 0), 1.0f);
    EXPECT_THROW(build_brick_tree(grid->tree()), TooWide);
}

TEST(BrickTree, KeepsThePrecisionOfExtremeValues) {
    for (const float scale : {1e-30f, 1e-6f, 1.0f, 1e6f, 1e30f}) {
        const auto grid = empty_grid();
        grid->tree().setValue(Coord(0), scale);
        grid->tree().setValue(Coord(1, 0, 0), 0.001f * scale);
        const BuiltTree built = build_brick_tree(grid->tree());
        EXPECT_NEAR(built.tree.voxel(V3i(0) - built.origin) / scale, 1.0f, 0x1p-11);
        EXPECT_NEAR(built.tree.voxel(V3i(1, 0, 0) - built.origin) / scale, 0.001f,
                    0.001f * 0x1p-11);
    }
}

/// Along a ray, segments follow each other without overlap, hold only density below their majorant,
/// and leave out only what is empty.
void expect_segments_cover(const BrickTree& tree, const LocalRay& ray) {
    // Rounding of a position, times the steepest slope the field can have.
    const float slack = 2e-4f * tree.max();
    const float speed = ray.direction.length();
    float reach = 0.0f;
    for (int corner = 0; corner < 8; ++corner) {
        const V3f at(static_cast<float>(corner & 1 ? tree.high().x : tree.low().x),
                     static_cast<float>(corner & 2 ? tree.high().y : tree.low().y),
                     static_cast<float>(corner & 4 ? tree.high().z : tree.low().z));
        reach = std::max(reach, (at - ray.origin).length() / speed);
    }
    const float step = 0.23f / speed;
    MajorantIterator majorants(tree, ray);
    MajorantSegment segment;
    float covered = 0.0f;
    const auto expect_below = [&](float begin, float end, float majorant) {
        for (float t = begin; t < end; t += step) {
            ASSERT_LE(tree.interpolate(ray.at(t)), majorant + slack)
                << "at t = " << t << " of " << ray.origin << " + t " << ray.direction << ", in ["
                << begin << ", " << end << ")";
        }
    };
    while (majorants.next(segment)) {
        ASSERT_GE(segment.begin, covered);
        ASSERT_GT(segment.end, segment.begin);
        ASSERT_GT(segment.majorant, 0.0f);
        expect_below(covered, segment.begin, 0.0f);
        expect_below(segment.begin, segment.end, segment.majorant);
        if (testing::Test::HasFatalFailure()) return;
        covered = segment.end;
    }
    expect_below(covered, reach, 0.0f);
}

class MajorantIteratorTest : public testing::Test {
  protected:
    MajorantIteratorTest() {
        const auto sparse = random_sparse_grid(8);
        sparse->tree().addTile(2, Coord(128, 0, 0), 0.8f, true);
        built_.push_back(build_brick_tree(sparse->tree()));
        built_.push_back(build_brick_tree(test::noise_grid(20, 4, 1.0)->tree()));
        built_.push_back(build_brick_tree(test::box_grid(Coord(8), openvdb::Vec3d(1.0))->tree()));
    }
    std::vector<BuiltTree> built_;
};

TEST_F(MajorantIteratorTest, CoversRandomRays) {
    Random random(1);
    for (const BuiltTree& built : built_) {
        for (int i = 0; i < 1500; ++i) {
            const V3f low(built.tree.low()), high(built.tree.high());
            // Half of them start inside the box.
            const float margin = i % 2 ? 0.0f : 1.0f;
            V3f origin, direction;
            for (int axis = 0; axis < 3; ++axis) {
                const float u = (1.0f + 2.0f * margin) * random.uniform() - margin;
                origin[axis] = low[axis] + u * (high[axis] - low[axis]);
                direction[axis] = 2.0f * random.uniform() - 1.0f;
            }
            expect_segments_cover(built.tree, {origin, direction * (0.1f + random.uniform())});
            if (HasFatalFailure()) return;
        }
    }
}

TEST_F(MajorantIteratorTest, CoversRaysAlongFacesThroughCornersAndAlmostSo) {
    // Components of directions: along an axis, across it, and so little of it that it has no
    // reciprocal, or one that overflows.
    const float components[] = {0.0f, -0.0f, 1.0f, -1.0f, 1e-7f, -1e-7f, 1e-35f, -1e-35f};
    Random random(2);
    for (const BuiltTree& built : built_) {
        for (int i = 0; i < 6000; ++i) {
            V3f origin, direction;
            for (int axis = 0; axis < 3; ++axis) {
                const int low = built.tree.low()[axis], high = built.tree.high()[axis];
                const int whole = low + draw(random, high - low + 1);
                const int kind = draw(random, 5);
                origin[axis] = kind == 0   ? static_cast<float>(whole)
                               : kind == 1 ? static_cast<float>(whole & ~7)
                               : kind == 2 ? static_cast<float>(low)
                               : kind == 3 ? static_cast<float>(high)
                                           : static_cast<float>(whole) + random.uniform();
                direction[axis] = components[draw(random, 8)];
            }
            if (direction.length() < 0.5f) continue;
            expect_segments_cover(built.tree, {origin, direction});
            if (HasFatalFailure()) return;
        }
    }
}

TEST_F(MajorantIteratorTest, SpansTheWholeOfAConstantBox) {
    // In the last tree the field is positive in (7, 16) along each axis, local coordinates.
    const BrickTree& tree = built_.back().tree;
    for (const V3f& direction : {V3f(1.0f, 0.0f, 0.0f), V3f(-1.0f, 0.0f, 0.0f),
                                 V3f(0.0f, 1.0f, 0.0f), V3f(0.0f, 0.0f, -1.0f)}) {
        const V3f origin = V3f(11.0f) - direction * 50.0f;
        MajorantIterator majorants(tree, {origin, direction});
        MajorantSegment segment;
        float covered = 0.0f;
        while (majorants.next(segment)) {
            EXPECT_EQ(segment.majorant, 1.0f);
            covered += segment.end - segment.begin;
        }
        EXPECT_FLOAT_EQ(covered, 9.0f) << direction;
    }
}

}  // namespace
}  // namespace pileus
