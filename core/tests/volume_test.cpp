// Volumes read from real files: which grids are taken, where they lie in the world, and the one
// line that says what is wrong with the rest.
#include "volume.h"

#include "error.h"
#include "printable.h"
#include "support.h"

#include <openvdb/io/Stream.h>
#include <openvdb/points/PointConversion.h>
#include <openvdb/tools/LevelSetSphere.h>

#include <cmath>
#include <fstream>
#include <gtest/gtest.h>
#include <sstream>

namespace pileus {
namespace {

using openvdb::Coord;
using openvdb::FloatGrid;
using openvdb::Vec3d;
using openvdb::math::Transform;

class VolumeTest : public testing::Test {
  protected:
    VolumeTest() { openvdb::initialize(); }

    static FloatGrid::Ptr dot(const std::string& name, float value) {
        auto grid = FloatGrid::create(0.0f);
        grid->setName(name);
        grid->tree().setValue(Coord(1, 2, 3), value);
        return grid;
    }

    std::string write(const openvdb::GridPtrVec& grids) {
        return test::write_grids(folder_.path("cache.vdb"), grids);
    }

    static float at(const Volume& volume, const Vec3d& world) {
        const V3d local = V3d(world.x(), world.y(), world.z()) * volume.world_to_local();
        return volume.empty() ? 0.0f : volume.tree().interpolate(V3f(local));
    }

    /// The one line that refuses a grid.
    static std::string refusal(const std::string& path, const std::string& grid) {
        try {
            const Volume volume(path, grid);
        } catch (const InputError& error) {
            const std::string line = error.what();
            EXPECT_EQ(line.find('\n'), std::string::npos) << line;
            EXPECT_NE(line.find(path), std::string::npos) << line;
            return line;
        }
        ADD_FAILURE() << "grid \"" << grid << "\" was taken";
        return "";
    }

    static bool holds(const std::string& text, const std::string& part) {
        return text.find(part) != std::string::npos;
    }

    test::TemporaryFolder folder_;
};

TEST_F(VolumeTest, TakesFloatHalfAndDouble) {
    auto half = dot("half", 0.5f);
    half->setSaveFloatAsHalf(true);
    auto wide = openvdb::DoubleGrid::create(0.0);
    wide->setName("double");
    wide->tree().setValue(Coord(1, 2, 3), 0.25);
    const std::string path = write({dot("float", 0.75f), half, wide});
    EXPECT_EQ(at(Volume(path, "float"), Vec3d(1, 2, 3)), 0.75f);
    EXPECT_EQ(at(Volume(path, "half"), Vec3d(1, 2, 3)), 0.5f);
    EXPECT_EQ(at(Volume(path, "double"), Vec3d(1, 2, 3)), 0.25f);
    EXPECT_EQ(Volume(path, "float").active_voxels(), 1);
    EXPECT_TRUE(Volume(path, "float").warnings().empty());
}

TEST_F(VolumeTest, TakesUnnamedGridsAndTheNthOfOneName) {
    const std::string unnamed = test::write_grids(folder_.path("unnamed.vdb"), {dot("", 0.5f)});
    EXPECT_EQ(at(Volume(unnamed, ""), Vec3d(1, 2, 3)), 0.5f);
    const std::string path = write(
        {dot("density", 0.125f), dot("density", 0.25f), dot("density", 0.5f), dot("t", 1.0f)});
    EXPECT_EQ(at(Volume(path, "density"), Vec3d(1, 2, 3)), 0.125f);
    EXPECT_EQ(at(Volume(path, "density[0]"), Vec3d(1, 2, 3)), 0.125f);
    EXPECT_EQ(at(Volume(path, "density[1]"), Vec3d(1, 2, 3)), 0.25f);
    EXPECT_EQ(at(Volume(path, "density[2]"), Vec3d(1, 2, 3)), 0.5f);
    EXPECT_TRUE(holds(refusal(path, "density[3]"), "density[2]"));
    const std::string two =
        test::write_grids(folder_.path("two.vdb"), {dot("", 0.5f), dot("", 0.25f)});
    EXPECT_EQ(at(Volume(two, ""), Vec3d(1, 2, 3)), 0.5f);
    EXPECT_EQ(at(Volume(two, "[1]"), Vec3d(1, 2, 3)), 0.25f);
}

TEST_F(VolumeTest, TakesInstancesAndFilesWrittenAsStreams) {
    const auto first = dot("density", 0.5f);
    const auto second = FloatGrid::create(first->treePtr());
    second->setName("again");
    second->setTransform(Transform::createLinearTransform(2.0));
    const std::string path = write({first, second});  // the tree is in the file once
    EXPECT_EQ(at(Volume(path, "density"), Vec3d(1, 2, 3)), 0.5f);
    EXPECT_EQ(at(Volume(path, "again"), Vec3d(2, 4, 6)), 0.5f);

    const std::string streamed = folder_.path("streamed.vdb");
    {
        std::ofstream out(streamed, std::ios::binary);
        openvdb::io::Stream(out).write(openvdb::GridCPtrVec{dot("other", 0.25f), first, second});
    }
    EXPECT_EQ(at(Volume(streamed, "density"), Vec3d(1, 2, 3)), 0.5f);
    EXPECT_EQ(at(Volume(streamed, "other"), Vec3d(1, 2, 3)), 0.25f);
    EXPECT_EQ(at(Volume(streamed, "again"), Vec3d(2, 4, 6)), 0.5f);
}

struct Placement {
    const char* name;
    Transform::Ptr (*make)();
};

class PlacementTest : public VolumeTest, public testing::WithParamInterface<Placement> {};

TEST_P(PlacementTest, AnAnalyticFieldLiesWhereItWasPut) {
    // A field linear in the world, sampled at the voxels: read back anywhere between them it is
    // itself. Half a voxel of shift would be an error of half a step along each axis.
    const auto transform = GetParam().make();
    auto grid = FloatGrid::create(0.0f);
    grid->setName("density");
    grid->setTransform(transform);
    constexpr int width = 12;
    // One per voxel along x, 3 along y and 5 along z, in whatever space that is.
    const auto field = [&](const Vec3d& world) {
        const Vec3d index = transform->worldToIndex(world);
        return 20.0 + index.x() + 3.0 * index.y() + 5.0 * index.z();
    };
    for (int x = 0; x < width; ++x) {
        for (int y = 0; y < width; ++y) {
            for (int z = 0; z < width; ++z) {
                const Coord at(x - 4, y, z + 9);
                grid->tree().setValue(at, float(field(transform->indexToWorld(at))));
            }
        }
    }
    const Volume volume(write({grid}), "density");
    const auto bounds = volume.world_bounds();
    ASSERT_TRUE(bounds);
    Random random(3);
    for (int i = 0; i < 2000; ++i) {
        const Vec3d index(-4.0 + (width - 1) * random.uniform(), (width - 1) * random.uniform(),
                          9.0 + (width - 1) * random.uniform());
        const Vec3d world = transform->indexToWorld(index);
        ASSERT_NEAR(at(volume, world), field(world), 0.01);  // a hundredth of a voxel
        for (int axis = 0; axis < 3; ++axis) {
            EXPECT_LE(bounds->first[axis], world[axis]);
            EXPECT_GE(bounds->second[axis], world[axis]);
        }
    }
}

INSTANTIATE_TEST_SUITE_P(
    Transforms, PlacementTest,
    testing::Values(Placement{"Uniform", [] { return Transform::createLinearTransform(0.02); }},
                    Placement{"NonUniform",
                              [] {
                                  auto t = Transform::createLinearTransform();
                                  t->preScale(Vec3d(0.1, 3.0, 0.004));
                                  return t;
                              }},
                    Placement{"RotatedAndSheared",
                              [] {
                                  auto t = Transform::createLinearTransform(0.1);
                                  t->postRotate(0.7, openvdb::math::X_AXIS);
                                  t->postShear(0.4, openvdb::math::X_AXIS, openvdb::math::Z_AXIS);
                                  t->postRotate(-0.3, openvdb::math::Z_AXIS);
                                  t->postTranslate(Vec3d(1.0, -2.0, 3.0));
                                  return t;
                              }},
                    Placement{"Mirrored",
                              [] {
                                  auto t = Transform::createLinearTransform();
                                  t->preScale(Vec3d(-0.1, 0.1, 0.1));
                                  return t;
                              }},
                    Placement{"FarFromTheOrigin",
                              [] {
                                  auto t = Transform::createLinearTransform(0.1);
                                  t->postTranslate(Vec3d(3e6, -2e6, 1e6));
                                  return t;
                              }}),
    [](const auto& info) { return info.param.name; });

TEST_F(VolumeTest, FarIndicesKeepTheirPlace) {
    auto grid = FloatGrid::create(0.0f);
    grid->setName("density");
    const Coord far(20000000, -7000003, 123);
    grid->tree().setValue(far, 1.0f);
    const Volume volume(write({grid}), "density");
    const Vec3d centre = far.asVec3d();
    EXPECT_NEAR(at(volume, centre), 1.0f, 1e-3f);
    EXPECT_NEAR(at(volume, centre + Vec3d(0.25, 0.0, 0.0)), 0.75f, 1e-3f);
    EXPECT_NEAR(at(volume, centre - Vec3d(0.25, 0.5, 0.0)), 0.375f, 1e-3f);
}

TEST_F(VolumeTest, LevelSetsBecomeFog) {
    auto sphere =
        openvdb::tools::createLevelSetSphere<FloatGrid>(1.0f, openvdb::Vec3f(0.0f), 0.05f);
    sphere->setName("surface");
    const Volume volume(write({sphere}), "surface");
    ASSERT_EQ(volume.warnings().size(), 1u);
    EXPECT_TRUE(holds(volume.warnings()[0], "level set"));
    EXPECT_EQ(at(volume, Vec3d(0.0)), 1.0f);
    EXPECT_EQ(at(volume, Vec3d(0.5, 0.3, -0.4)), 1.0f);
    EXPECT_EQ(at(volume, Vec3d(0.8, 0.8, 0.0)), 0.0f);
    const float near_surface = at(volume, Vec3d(0.0, 0.93, 0.0));
    EXPECT_GT(near_surface, 0.0f);
    EXPECT_LT(near_surface, 1.0f);
}

TEST_F(VolumeTest, SaysWhatItTookAsZero) {
    auto grid = dot("density", 1.0f);
    grid->tree().setValue(Coord(5, 0, 0), std::nanf(""));
    grid->tree().setValue(Coord(6, 0, 0), -1.0f);
    grid->tree().setValue(Coord(7, 0, 0), -1.0f);
    grid->tree().setValue(Coord(8, 0, 0), std::numeric_limits<float>::infinity());
    const Volume volume(write({grid}), "density");
    ASSERT_EQ(volume.warnings().size(), 3u);
    EXPECT_TRUE(holds(volume.warnings()[0], "1 NaN"));
    EXPECT_TRUE(holds(volume.warnings()[1], "1 infinite"));
    EXPECT_TRUE(holds(volume.warnings()[2], "2 negative"));
    EXPECT_EQ(at(volume, Vec3d(6, 0, 0)), 0.0f);
}

TEST_F(VolumeTest, AnEmptyGridWarnsAndHasNoPlace) {
    auto grid = FloatGrid::create(0.0f);
    grid->setName("density");
    const Volume volume(write({grid}), "density");
    EXPECT_TRUE(volume.empty());
    EXPECT_FALSE(volume.world_bounds());
    ASSERT_EQ(volume.warnings().size(), 1u);
    EXPECT_TRUE(holds(volume.warnings()[0], "empty"));
}

TEST_F(VolumeTest, RefusesWhatIsNoDensityAndListsWhatThereIs) {
    auto velocity = openvdb::Vec3SGrid::create();
    velocity->setName("v");
    velocity->tree().setValue(Coord(0), openvdb::Vec3f(1.0f));
    auto flags = openvdb::Int32Grid::create();
    flags->setName("flags");
    auto mask = openvdb::MaskGrid::create();
    mask->setName("mask");
    const std::string path = write({dot("smoke", 1.0f), velocity, flags, mask});
    for (const char* wanted : {"density", "v", "flags", "mask", ""}) {
        const std::string line = refusal(path, wanted);
        for (const char* name : {"smoke", "v", "flags", "mask"}) {
            EXPECT_TRUE(holds(line, '"' + std::string(name) + '"')) << line;
        }
    }
    EXPECT_TRUE(holds(refusal(path, "v"), "vec3s")) << refusal(path, "v");

    std::vector<openvdb::Vec3R> positions{{0, 0, 0}, {1, 1, 1}};
    auto points = openvdb::points::createPointDataGrid<openvdb::points::NullCodec,
                                                       openvdb::points::PointDataGrid>(
        positions, *Transform::createLinearTransform(0.5));
    points->setName("points");
    EXPECT_TRUE(holds(refusal(test::write_grids(folder_.path("points.vdb"), {points}), "points"),
                      "ptdata"));
    EXPECT_TRUE(
        holds(refusal(test::write_grids(folder_.path("none.vdb"), {}), "density"), "no grid"));
}

TEST_F(VolumeTest, RefusesAFrustum) {
    auto grid = dot("density", 1.0f);
    grid->setTransform(
        Transform::createFrustumTransform(openvdb::BBoxd(Vec3d(0.0), Vec3d(10.0)), 0.5, 10.0, 0.1));
    EXPECT_TRUE(holds(refusal(write({grid}), "density"), "frustum"));
}

TEST_F(VolumeTest, RefusesAGridTooWide) {
    auto grid = dot("density", 1.0f);
    grid->tree().setValue(Coord(3000000, 0, 0), 1.0f);
    EXPECT_TRUE(holds(refusal(write({grid}), "density"), "spans"));
}

TEST_F(VolumeTest, RefusesFilesThatAreNotWhole) {
    EXPECT_TRUE(holds(refusal(folder_.path("absent.vdb"), "density"), "no such file"));
    EXPECT_NE(refusal(std::filesystem::temp_directory_path().string(), "density"), "");

    const std::string text = folder_.path("text.vdb");
    std::ofstream(text) << "not a volume at all\n";
    EXPECT_NE(refusal(text, "density"), "");
    const std::string nothing = folder_.path("nothing.vdb");
    std::ofstream{nothing};
    EXPECT_NE(refusal(nothing, "density"), "");

    const std::string whole = write({test::noise_grid(16, 1, 1.0)});
    std::ostringstream bytes;
    bytes << std::ifstream(whole, std::ios::binary).rdbuf();
    for (int tenth = 1; tenth < 10; ++tenth) {
        const std::string cut = folder_.path("cut.vdb");
        std::ofstream(cut, std::ios::binary)
            << bytes.str().substr(0, bytes.str().size() * tenth / 10);
        EXPECT_NE(refusal(cut, ""), "") << tenth;
    }
}

TEST_F(VolumeTest, RefusesCountsBeyondTheFile) {
    const std::string whole = write({dot("density", 1.0f)});
    std::ostringstream bytes;
    bytes << std::ifstream(whole, std::ios::binary).rdbuf();
    for (std::size_t place = 0; place + 4 < bytes.str().size(); place += 3) {
        std::string spoiled = bytes.str();
        spoiled.replace(place, 4, "\xff\xff\xff\x0f");
        const std::string path = folder_.path("spoiled.vdb");
        std::ofstream(path, std::ios::binary) << spoiled;
        try {
            const Volume volume(path, "density");
        } catch (const InputError& error) {
            EXPECT_FALSE(holds(error.what(), "\n"));
        }
    }
}

TEST(PrintableTest, IsOneLineOfUtf8ThatNoTerminalObeys) {
    EXPECT_EQ(printable("a.vdb: d\u00e9j\u00e0 \u96f2 \U0001F300"),
              "a.vdb: d\u00e9j\u00e0 \u96f2 \U0001F300");
    EXPECT_EQ(printable("a\nb\x1b[31m\x7f"), "a\\x0ab\\x1b[31m\\x7f");
    EXPECT_EQ(printable("\xff\xc3(\xe2\x82"), "\\xff\\xc3(\\xe2\\x82");
    EXPECT_EQ(printable("\xed\xa0\x80\xc0\xaf"), "\\xed\\xa0\\x80\\xc0\\xaf");
}

}  // namespace
}  // namespace pileus
