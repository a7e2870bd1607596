// Media reduced by similarity: what the relation keeps, where the reduction changes nothing, and
// how far it errs where the answer is known.
#include "schedule.h"

#include "support.h"

#include <gtest/gtest.h>

namespace pileus {
namespace {

using openvdb::Coord;
using openvdb::Vec3d;

std::shared_ptr<const Volume> cube_volume() {
    static const auto volume = test::volume_of(test::box_grid(Coord(16), Vec3d(1.0 / 16.0)));
    return volume;
}

Scene cube(const Color& albedo, float g, float sun_angle = 0.0f) {
    const Camera camera(V3d(1.1, 0.9, 1.7), V3d(0.0), V3d(0.0, 1.0, 0.0), 50.0);
    const std::shared_ptr<const Light> sun =
        make_distant_light(V3f(0.6f, -0.55f, -0.58f).normalized(), Color(3.0f), sun_angle);
    return test::make_scene(cube_volume(), camera, {sun, test::constant_dome(0.3f)},
                            {12.0f, albedo, g, 24, 24});
}

TEST(Schedule, KeepsAbsorptionAndReducedScattering) {
    const V3f middle((V3f(cube_volume()->tree().low()) + V3f(cube_volume()->tree().high())) * 0.5f);
    for (const auto& [g, from] : {std::pair{0.1f, 3},
                                  {0.5f, 3},
                                  {0.85f, 1},
                                  {0.85f, 2},
                                  {0.85f, 3},
                                  {0.85f, 20},
                                  {0.999f, 3}}) {
        const Medium medium(*cube_volume(), 12.0f, Color(0.9f, 0.7f, 0.99f), g);
        const Schedule schedule(medium, from);
        EXPECT_EQ(schedule.plain(), from);
        for (int n = 0; n < from; ++n) {
            EXPECT_EQ(schedule.at(n).phase().g(), g);
            EXPECT_EQ(schedule.order(n), n);
        }
        EXPECT_LT(schedule.at(from).phase().g(), g);
        EXPECT_EQ(schedule.at(40).phase().g(), 0.0f);
        const float sigma = medium.extinction(middle);
        for (int n = 0; n < 40; ++n) {
            const Medium& reduced = schedule.at(n);
            const float sigma_here = reduced.extinction(middle);
            // The channel that absorbs least is kept whole, the others in their absorption.
            EXPECT_NEAR(sigma_here * reduced.albedo().z * (1.0f - reduced.phase().g()),
                        sigma * 0.99f * (1.0f - g), 1e-4f * sigma);
            EXPECT_NEAR(sigma_here * (1.0f - reduced.albedo().z), sigma * 0.01f, 1e-4f * sigma);
            EXPECT_LE(schedule.at(n + 1).phase().g(), reduced.phase().g());
            EXPECT_GE(schedule.order(n + 1), n + 1);
        }
        // Far out each event stands for 1 / (1 - g).
        EXPECT_NEAR(schedule.order(1040) - schedule.order(40), 1000.0f / (1.0f - g),
                    1.0f + 1.0f / (1.0f - g));
        for (const int bound : {1, 2, 5, 300, 1 << 20}) {
            const int events = schedule.events(bound);
            EXPECT_LT(schedule.order(events - 1), bound);
            EXPECT_GE(schedule.order(events), bound);
        }
    }
}

TEST(Similarity, IsReferenceWhereNothingIsReduced) {
    // Without a forward lobe, or with a path that ends before the reduction.
    Transport late = test::transport_of("similarity", 4);
    late.reduce_from = 5;
    const auto expect_same = [](const Scene& scene, const Transport& a, const Transport& b) {
        EXPECT_EQ(test::render_whole(scene, a, 4).image.data(),
                  test::render_whole(scene, b, 4).image.data());
    };
    expect_same(cube(Color(0.8f), -0.4f), test::transport_of("similarity"),
                test::transport_of("reference"));
    expect_same(cube(Color(1.0f), 0.85f), late, test::transport_of("reference", 4));
}

TEST(Similarity, ErrsByAtMostTwoPercentInAThickCube) {
    for (const float albedo : {1.0f, 0.9f}) {
        const Scene scene = cube(Color(albedo), 0.85f, 2.0f);
        const auto truth = test::estimate(
            test::render_whole(scene, test::transport_of("reference"), 256), Partial::g);
        const auto ours = test::estimate(
            test::render_whole(scene, test::transport_of("similarity"), 256), Partial::g);
        EXPECT_NEAR(ours.mean, truth.mean, 0.02 * truth.mean) << albedo;
    }
}

}  // namespace
}  // namespace pileus
