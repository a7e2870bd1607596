// The procedural caches: the same bits however they are made, sound values, smooth motion, and
// velocities that tell where the volume goes.
#include "make/cloud.h"
#include "make/whitewater.h"

#include <openvdb/openvdb.h>
#include <tbb/global_control.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <filesystem>
#include <gtest/gtest.h>
#include <map>
#include <stdexcept>
#include <string>
#include <unistd.h>
#include <utility>

namespace pileus {
namespace {

namespace fs = std::filesystem;

struct Maker {
    const char* name;
    std::int64_t (*make)(const std::string&, const MakeOptions&);
    std::int64_t fewest;  // active voxels at resolution 256
    std::int64_t most;
    double extinction;   // of its example
    double least_depth;  // optical, through its heart
    int axis;            // along which the mass moves between frames 4 and 8 of 24
};

struct Made {
    std::int64_t active;
    openvdb::FloatGrid::Ptr density;
    openvdb::Vec3SGrid::Ptr velocity;
    openvdb::MetaMap::Ptr metadata;
};

class MakeTest : public testing::TestWithParam<Maker> {
  protected:
    void SetUp() override {
        openvdb::initialize();
        folder_ = fs::temp_directory_path() / ("pileus-make-" + std::to_string(::getpid()));
        fs::create_directories(folder_);
    }
    void TearDown() override { fs::remove_all(folder_); }

    std::string path(const std::string& name) const { return (folder_ / name).string(); }

    Made make(const MakeOptions& options) const {
        const std::string file = path("made.vdb");
        Made made;
        made.active = GetParam().make(file, options);
        openvdb::io::File reader(file);
        reader.open();
        made.density = openvdb::gridPtrCast<openvdb::FloatGrid>(reader.readGrid("density"));
        made.velocity = openvdb::gridPtrCast<openvdb::Vec3SGrid>(reader.readGrid("velocity"));
        made.metadata = reader.getMetadata();
        return made;
    }

    fs::path folder_;
};

/// The sum of differences in density over all voxels.
double difference(const openvdb::FloatGrid& a, const openvdb::FloatGrid& b) {
    openvdb::CoordBBox box = a.evalActiveVoxelBoundingBox();
    box.expand(b.evalActiveVoxelBoundingBox());
    const auto left = a.getConstAccessor();
    const auto right = b.getConstAccessor();
    double sum = 0.0;
    for (auto ijk = box.begin(); ijk; ++ijk) {
        sum += std::abs(static_cast<double>(left.getValue(*ijk)) - right.getValue(*ijk));
    }
    return sum;
}

/// The centre of mass and, where asked for, the mean velocity of the mass.
openvdb::Vec3d centre(const Made& made, openvdb::Vec3d* velocity = nullptr) {
    openvdb::Vec3d moment(0.0);
    openvdb::Vec3d momentum(0.0);
    double mass = 0.0;
    const auto flow = made.velocity->getConstAccessor();
    const auto density = made.density->getConstAccessor();
    const openvdb::CoordBBox box = made.density->evalActiveVoxelBoundingBox();
    for (auto ijk = box.begin(); ijk; ++ijk) {
        const double m = density.getValue(*ijk);
        if (m == 0.0) continue;
        mass += m;
        moment += made.density->indexToWorld(*ijk) * m;
        momentum += openvdb::Vec3d(flow.getValue(*ijk)) * m;
    }
    if (velocity != nullptr) *velocity = momentum / mass;
    return moment / mass;
}

TEST_P(MakeTest, FillsTheRangeWithSoundValues) {
    const Made made = make({.frame = 12, .frames = 24, .resolution = 256, .seed = 0});
    EXPECT_GE(made.active, GetParam().fewest);
    EXPECT_LE(made.active, GetParam().most);
    EXPECT_EQ(static_cast<std::int64_t>(made.density->activeVoxelCount()), made.active);
    EXPECT_EQ(static_cast<std::int64_t>(made.velocity->activeVoxelCount()), made.active);
    EXPECT_EQ(made.density->getGridClass(), openvdb::GRID_FOG_VOLUME);
    EXPECT_TRUE(made.density->saveFloatAsHalf());
    EXPECT_EQ(made.metadata->metaValue<std::int32_t>("frame"), 12);
    bool sound = true;
    for (auto value = made.density->cbeginValueOn(); value; ++value) {
        sound = sound && value.getValue() > 0.0F && value.getValue() <= 1.0F;
    }
    for (auto value = made.velocity->cbeginValueOn(); value; ++value) {
        sound = sound && std::isfinite(value.getValue().lengthSqr());
    }
    EXPECT_TRUE(sound);
}

TEST_P(MakeTest, IsTheSameToTheBitOnAnyNumberOfThreads) {
    const MakeOptions options{.frame = 9, .frames = 24, .resolution = 96, .seed = 5};
    const Made many = make(options);
    const tbb::global_control one(tbb::global_control::max_allowed_parallelism, 1);
    const Made alone = make(options);
    EXPECT_TRUE(many.density->tree().hasSameTopology(alone.density->tree()));
    bool same = true;
    const auto density = alone.density->getConstAccessor();
    for (auto value = many.density->cbeginValueOn(); value; ++value) {
        same = same && *value == density.getValue(value.getCoord());
    }
    const auto velocity = alone.velocity->getConstAccessor();
    for (auto value = many.velocity->cbeginValueOn(); value; ++value) {
        same = same && *value == velocity.getValue(value.getCoord());
    }
    EXPECT_TRUE(same);
}

TEST_P(MakeTest, MovesSmoothlyAndWithItsVelocity) {
    const auto at = [&](int frame) {
        return make({.frame = frame, .frames = 24, .resolution = 96, .seed = 0});
    };
    const Made now = at(5);
    const Made next = at(6);
    const Made later = at(14);
    const double step = difference(*now.density, *next.density);
    EXPECT_GT(step, 0.0);
    EXPECT_LT(2.0 * step, difference(*now.density, *later.density));

    openvdb::Vec3d velocity;
    const openvdb::Vec3d from = centre(now, &velocity);
    const openvdb::Vec3d moved = centre(at(8)) - from;
    EXPECT_GT(moved[GetParam().axis] * velocity[GetParam().axis], 0.0);
}

TEST_P(MakeTest, DependsOnTheSeed) {
    const Made a = make({.frame = 9, .frames = 24, .resolution = 48, .seed = 0});
    const Made b = make({.frame = 9, .frames = 24, .resolution = 48, .seed = 1ULL << 40});
    EXPECT_GT(difference(*a.density, *b.density), 100.0);
}

TEST_P(MakeTest, IsOpaqueInItsHeart) {
    const Made made = make({.frame = 14, .frames = 24, .resolution = 96, .seed = 0});
    // Along the view, above the foam that lies on still water.
    std::map<std::pair<int, int>, double> columns;
    for (auto value = made.density->cbeginValueOn(); value; ++value) {
        openvdb::CoordBBox box;
        value.getBoundingBox(box);
        for (auto ijk = box.begin(); ijk; ++ijk) {
            if (made.density->indexToWorld(*ijk).y() < -0.2) continue;
            columns[{(*ijk).x(), (*ijk).y()}] += *value * made.density->voxelSize().z();
        }
    }
    double thickest = 0.0;
    for (const auto& [place, length] : columns) thickest = std::max(thickest, length);
    EXPECT_GT(GetParam().extinction * thickest, GetParam().least_depth);
}

TEST_P(MakeTest, RefusesWhatItCannotMake) {
    const std::string file = path("made.vdb");
    EXPECT_THROW(GetParam().make(file, {.resolution = 7}), std::invalid_argument);
    EXPECT_THROW(GetParam().make(file, {.resolution = 4097}), std::invalid_argument);
    EXPECT_THROW(GetParam().make(file, {.frames = 0}), std::invalid_argument);
    EXPECT_THROW(GetParam().make(file, {.frame = 0}), std::invalid_argument);
    EXPECT_THROW(GetParam().make(path("nowhere/made.vdb"), {.resolution = 16}), std::runtime_error);
    EXPECT_TRUE(fs::is_empty(folder_));
}

INSTANTIATE_TEST_SUITE_P(
    Both, MakeTest,
    testing::Values(Maker{"Cloud", &make_cloud, 2'000'000, 5'000'000, 160.0, 40.0, 0},
                    Maker{"Whitewater", &make_whitewater, 1'000'000, 4'000'000, 2000.0, 500.0, 1}),
    [](const auto& info) { return std::string(info.param.name); });

}  // namespace
}  // namespace pileus
