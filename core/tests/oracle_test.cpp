// Whole renders against known answers: radiative transfer's closed forms and tables, white
// furnaces, and quadrature through fields whose optical depth is known exactly.
#include "support.h"

#include <array>
#include <cmath>
#include <gtest/gtest.h>
#include <vector>

namespace pileus {
namespace {

using openvdb::Coord;
using openvdb::Vec3d;

/// Every statistical comparison of this file is at this confidence.
constexpr double confidence = 0.999;

/// A lat-long dome whose texels are given by a function of column and row, upper row first.
std::shared_ptr<const Light> textured_dome(int width, int height,
                                           const std::function<float(int, int)>& radiance) {
    const test::TemporaryFolder folder;
    LayeredImage image({0, 0, width, height}, {"dome"}, {"R", "G", "B"});
    for (std::size_t c = 0; c < 3; ++c) {
        for (int i = 0; i < width * height; ++i) {
            image.plane(0, c)[i] = radiance(i % width, i / width);
        }
    }
    write_exr(folder.path("dome.exr"), image, width, height, false, {});
    std::vector<std::string> warnings;
    return make_dome_light(Color(1.0f), folder.path("dome.exr"), warnings);
}

/// Light from above alone: radiance 1 where y > 0.
std::shared_ptr<const Light> upper_half_dome() {
    return textured_dome(4, 512, [](int, int row) { return row < 256 ? 1.0f : 0.0f; });
}

/// A slab across y, so wide that its sides are never met, seen along its normal from above or
/// below. Eight voxels of 1/8 make its optical thickness the extinction, the ramps at its faces
/// included: where the albedo is constant, only that thickness matters.
Scene slab(float thickness, float albedo, float g, bool from_above,
           std::vector<std::shared_ptr<const Light>> lights) {
    const auto volume = test::volume_of(test::box_grid(Coord(8), Vec3d(1e4, 0.125, 1e4)));
    const double height = from_above ? 5.0 : -5.0;
    const Camera camera(V3d(0.0, height, 0.0), V3d(0.0), V3d(0.0, 0.0, 1.0), 0.01);
    return test::make_scene(volume, camera, std::move(lights),
                            {thickness, Color(albedo), g, 64, 64});
}

struct SemiInfinite {
    float albedo;
    double reflectance;
    int samples;  // of each of 4096 pixels
};

class SemiInfiniteTest : public testing::TestWithParam<SemiInfinite> {};

TEST_P(SemiInfiniteTest, ReflectsAsChandrasekharsHFunctionSays) {
    // By reciprocity the radiance seen along the normal under a uniform dome is the albedo of the
    // plane for light along the normal: 1 - H(1) sqrt(1 - w).
    const auto& [albedo, reflectance, samples] = GetParam();
    const Scene scene = slab(400.0f, albedo, 0.0f, true, {test::constant_dome()});
    const auto [mean, error] = test::estimate(
        test::render_whole(scene, test::transport_of("reference"), samples), Partial::g);
    EXPECT_LT(error, 0.002);
    EXPECT_NEAR(mean, reflectance, test::z_limit(confidence) * error + 1e-5);
}

INSTANTIATE_TEST_SUITE_P(
    Oracle, SemiInfiniteTest,
    testing::Values(SemiInfinite{0.5f, 0.11523, 128}, SemiInfinite{0.8f, 0.28525, 128},
                    SemiInfinite{0.9f, 0.41495, 64}, SemiInfinite{0.99f, 0.75272, 32},
                    SemiInfinite{0.999f, 0.91285, 8}),
    [](const auto& info) {
        return "Albedo" + std::to_string(std::lround(info.param.albedo * 1000.0f));
    });

struct Slab {
    const char* name;
    float thickness, albedo, g;
    double reflectance, transmittance;
    double tolerance;  // of the two
    int samples;
};

class SlabTest : public testing::TestWithParam<Slab> {};

TEST_P(SlabTest, ReflectsAndTransmitsAsTabulated) {
    const Slab& s = GetParam();
    for (const bool above : {true, false}) {
        const Scene scene = slab(s.thickness, s.albedo, s.g, above, {upper_half_dome()});
        const auto [mean, error] = test::estimate(
            test::render_whole(scene, test::transport_of("reference"), s.samples), Partial::g);
        EXPECT_LT(error, 0.0015);
        EXPECT_NEAR(mean, above ? s.reflectance : s.transmittance,
                    test::z_limit(confidence, 2) * error + s.tolerance)
            << (above ? "reflectance" : "transmittance");
    }
}

INSTANTIATE_TEST_SUITE_P(
    Oracle, SlabTest,
    testing::Values(Slab{"Forward", 2.0f, 0.9f, 0.75f, 0.09746, 0.66090, 7e-5, 128},
                    Slab{"Isotropic", 2.0f, 1.0f, 0.0f, 0.51765, 1.0 - 0.51765, 2e-4, 96},
                    Slab{"Thick", 16.0f, 1.0f, 0.85f, 0.55645, 1.0 - 0.55645, 4e-4, 64}),
    [](const auto& info) { return info.param.name; });

/// A homogeneous cube of side 1 and optical thickness `extinction`, filling most of the view.
Scene cube(float extinction, const Color& albedo, float g,
           std::vector<std::shared_ptr<const Light>> lights, int resolution = 16) {
    static const auto volume = test::volume_of(test::box_grid(Coord(192), Vec3d(1.0 / 192.0)));
    const Camera camera(V3d(1.1, 0.9, 1.7), V3d(0.0), V3d(0.0, 1.0, 0.0), 50.0);
    return test::make_scene(volume, camera, std::move(lights),
                            {extinction, albedo, g, resolution, resolution});
}

TEST(WhiteFurnace, TrackedMethodsAreOneAtEveryPixel) {
    // Every path ends in the dome with its whole weight: not only the mean is 1.
    for (const char* method : {"reference", "similarity"}) {
        for (const float g : {-0.9f, 0.0f, 0.85f}) {
            const Scene scene = cube(10.0f, Color(1.0f), g, {test::constant_dome()});
            const Partial partial = test::render_whole(scene, test::transport_of(method), 16);
            EXPECT_EQ(partial.bounded_paths, 0);
            for (std::size_t i = 0; i < 256; ++i) {
                ASSERT_FLOAT_EQ(partial.image.plane(0, Partial::r)[i], 1.0f) << method << i;
            }
        }
    }
}

TEST(WhiteFurnace, HoldsWhereNoLightPassesAVoxel) {
    // The work along a ray is bounded however thick the medium: without that, this has no end.
    for (const char* method : {"multiple", "reference"}) {
        const Scene scene = cube(1e9f, Color(0.5f), 0.0f, {test::constant_dome()}, 8);
        const Partial partial = test::render_whole(scene, test::transport_of(method, 4), 4);
        for (std::size_t i = 0; i < 64; ++i) {
            const float radiance = partial.image.plane(0, Partial::r)[i];
            const float opacity = partial.image.plane(0, Partial::a)[i];
            EXPECT_TRUE(opacity == 0.0f ? radiance == 1.0f : radiance >= 0.0f && radiance < 1.5f);
        }
        EXPECT_EQ(partial.image.plane(0, Partial::a)[27], 1.0f);
    }
}

Camera camera_inside() { return Camera(V3d(0.2, -0.1, 0.3), V3d(1.0), V3d(0.0, 1.0, 0.0), 120.0); }

TEST(WhiteFurnace, HoldsForACameraInside) {
    Scene scene = cube(8.0f, Color(1.0f), 0.5f, {test::constant_dome()});
    scene.camera = camera_inside();
    const Partial partial = test::render_whole(scene, test::transport_of("reference"), 16);
    for (std::size_t i = 0; i < 256; ++i) {
        ASSERT_FLOAT_EQ(partial.image.plane(0, Partial::g)[i], 1.0f) << i;
    }
}

TEST(WhiteFurnace, MultipleIsOneForACameraInsideButForTheRampsAtTheFaces) {
    // In the voxel over which the density falls to 0 the walk is not exact, and makes light in
    // proportion to its width: two widths tell what there would be without.
    const auto mean_of = [](int voxels) {
        const auto volume =
            test::volume_of(test::box_grid(Coord(voxels), Vec3d(1.0 / double(voxels))));
        const Scene scene = test::make_scene(volume, camera_inside(), {test::constant_dome()},
                                             {8.0f, Color(1.0f), 0.5f, 16, 16});
        return test::estimate(test::render_whole(scene, test::transport_of("multiple", 256), 512),
                              Partial::g);
    };
    const auto [wide, wide_error] = mean_of(192);
    const auto [narrow, narrow_error] = mean_of(384);
    EXPECT_NEAR(2.0 * narrow - wide, 1.0,
                test::z_limit(confidence) * std::hypot(2.0 * narrow_error, wide_error));
    EXPECT_LT(narrow_error, 0.005);
}

TEST(WhiteFurnace, HoldsWhereTheDomeIsSampledAndHit) {
    // A texture of ones is sampled by texels and hit by walks: the two must share the light.
    const auto dome = textured_dome(8, 4, [](int, int) { return 1.0f; });
    for (const float g : {-0.6f, 0.0f, 0.85f}) {
        const auto [mean, error] =
            test::estimate(test::render_whole(cube(4.0f, Color(1.0f), g, {dome}),
                                              test::transport_of("reference"), 64),
                           Partial::g);
        EXPECT_LT(error, 0.01);
        EXPECT_NEAR(mean, 1.0, test::z_limit(confidence, 3) * error) << g;
    }
}

TEST(WhiteFurnace, HoldsByShadowRays) {
    // A look a hair from physical gets its sky by shadow rays instead of the walk.
    for (const float g : {-0.6f, 0.0f, 0.85f}) {
        const Scene scene = cube(4.0f, Color(1.0f), g, {test::constant_dome()});
        const Look near{"near", 0.999999f, 0.999999f, 0.999999f};
        const auto [mean, error] = test::estimate(
            test::render_whole(scene, test::transport_of("reference", {}, {near}), 32), Partial::g);
        EXPECT_LT(error, 0.01);
        EXPECT_NEAR(mean, 1.0, test::z_limit(confidence, 3) * error + 1e-4) << g;
    }
}

TEST(WhiteFurnace, MultipleIsOneInAHomogeneousBox) {
    // Optical thickness 4: after 96 orders less than 1e-4 of the light is still inside. The ramps
    // at the faces, where the walk is not exact, are 2 % of a mean free path wide.
    const Scene scene = cube(4.0f, Color(1.0f), 0.0f, {test::constant_dome()});
    const auto [mean, error] = test::estimate(
        test::render_whole(scene, test::transport_of("multiple", 96), 64), Partial::g);
    EXPECT_LT(error, 0.005);
    EXPECT_NEAR(mean, 1.0, test::z_limit(confidence) * error + 1e-3);
}

/// Two looks of one render, whose paths are the same, agree: their difference, pixel by pixel, has
/// mean zero.
void expect_looks_agree(const Partial& partial, double tolerance) {
    std::vector<double> gaps;
    double mean = 0.0;
    const std::size_t pixels = partial.image.window().pixels();
    for (std::size_t i = 0; i < pixels; ++i) {
        gaps.push_back(double{partial.image.plane(0, Partial::g)[i]} -
                       partial.image.plane(1, Partial::g)[i]);
        mean += partial.image.plane(0, Partial::g)[i] / double(pixels);
    }
    const auto [gap, error] = test::estimate(gaps);
    EXPECT_LT(error, 0.02 * mean);
    EXPECT_NEAR(gap, 0.0, test::z_limit(confidence, 3) * error + tolerance * mean);
}

TEST(Sky, ASmallBrightSpotIsTheSameByWalkAndByShadowRays) {
    // One texel of 2048 sends nearly all the light: the walk alone would hardly find it.
    const auto dome =
        textured_dome(64, 32, [](int x, int y) { return x == 40 && y == 9 ? 500.0f : 0.05f; });
    for (const float g : {-0.5f, 0.0f, 0.8f}) {
        const Scene scene = cube(3.0f, Color(0.95f), g, {dome}, 32);
        expect_looks_agree(
            test::render_whole(
                scene,
                test::transport_of("reference", {},
                                   {{"physical"}, {"near", 0.999999f, 0.999999f, 0.999999f}}),
                128),
            1e-4);
    }
}

/// A distant light that is taken for one that rays may meet (none does): there are no bridges to
/// it.
class WithoutBridges final : public Light {
  public:
    explicit WithoutBridges(std::shared_ptr<const Light> sun) : sun_(std::move(sun)) {}
    std::optional<LightSample> sample(float u1, float u2) const override {
        auto sample = sun_->sample(u1, u2);
        if (sample) sample->density = 1e30f;  // beyond any phase function's
        return sample;
    }
    float density(const V3f&) const override { return 0.0f; }
    Color radiance(const V3f&) const override { return Color(0.0f); }
    bool can_be_hit() const override { return true; }

  private:
    std::shared_ptr<const Light> sun_;
};

TEST(Bridges, BringTheLightOfEachOrderThatShadowRaysBring) {
    // Lumps of all densities and hollows between them, where `multiple` flies now by the local
    // extinction and now by tracking.
    openvdb::initialize();
    auto grid = openvdb::FloatGrid::create(0.0f);
    Random random(3);
    constexpr int lumps = 8, lump = 4;
    for (int i = 0; i < lumps * lumps * lumps; ++i) {
        const Coord low(i % lumps * lump, i / lumps % lumps * lump, i / (lumps * lumps) * lump);
        const float density = random.uniform() - 0.4f;
        if (density > 0.0f) grid->fill(openvdb::CoordBBox::createCube(low, lump), density);
    }
    grid->setTransform(openvdb::math::Transform::createLinearTransform(1.0 / (lumps * lump)));
    const auto volume = test::volume_of(grid);
    const Camera camera(V3d(0.5, 0.5, 3.0), V3d(0.5), V3d(0.0, 1.0, 0.0), 25.0);
    const std::shared_ptr<const Light> sun =
        make_distant_light(V3f(0.6f, -0.55f, -0.58f).normalized(), Color(3.0f), 1.0f);
    constexpr int orders = 5;
    const std::vector<Look> looks{{"physical"}, {"hero", 0.6f, 0.7f, 0.5f}};
    for (const char* method : {"multiple", "reference"}) {
        const auto seen = [&](std::shared_ptr<const Light> light, int samples) {
            const Scene scene = test::make_scene(volume, camera, {std::move(light)},
                                                 {30.0f, Color(0.7f, 0.9f, 1.0f), 0.6f, 48, 48});
            return test::render_whole(scene, test::transport_of(method, orders, looks), samples,
                                      true);
        };
        const Partial bridged = seen(sun, 128);
        const Partial plain = seen(std::make_shared<WithoutBridges>(sun), 512);
        for (std::size_t look = 0; look < looks.size(); ++look) {
            for (std::size_t order = 0; order < orders; ++order) {
                const std::size_t green = Partial::first_order + 3 * order + 1;
                std::vector<double> gaps;
                double mean = 0.0;
                for (std::size_t i = 0; i < plain.image.window().pixels(); ++i) {
                    const double other = plain.image.plane(look, green)[i];
                    gaps.push_back(bridged.image.plane(look, green)[i] - other);
                    mean += other / static_cast<double>(plain.image.window().pixels());
                }
                const auto [gap, error] = test::estimate(gaps);
                EXPECT_NEAR(gap, 0.0, test::z_limit(confidence, 4 * orders) * error)
                    << method << ", " << looks[look].name << ", order " << order;
                EXPECT_LT(error, 0.008 * mean)
                    << method << ", " << looks[look].name << ", order " << order;
            }
        }
    }
}

TEST(Methods, AgreeWhereTheirModelsDo) {
    // In a homogeneous cube `density` and `multiple` model the same transport as `reference` with
    // as many orders; coloured albedo below 1, light scattered backwards, sun and sky.
    const std::vector<std::shared_ptr<const Light>> lights{
        std::shared_ptr<const Light>(
            make_distant_light(V3f(0.6f, -0.55f, -0.58f).normalized(), Color(3.0f), 2.0f)),
        test::constant_dome(0.4f)};
    for (const float g : {-0.7f, 0.6f}) {
        const Scene scene = cube(5.0f, Color(0.5f, 0.8f, 0.98f), g, lights, 32);
        const Partial truth = test::render_whole(scene, test::transport_of("reference", 12), 48);
        for (const char* method : {"density", "multiple"}) {
            const Partial other = test::render_whole(scene, test::transport_of(method, 12), 16);
            for (const auto channel : {Partial::r, Partial::g, Partial::b, Partial::a}) {
                // The image is not uniform: the difference, pixel by pixel, is what has an error.
                std::vector<double> gaps;
                double mean = 0.0;
                for (std::size_t i = 0; i < 1024; ++i) {
                    gaps.push_back(double{other.image.plane(0, channel)[i]} -
                                   truth.image.plane(0, channel)[i]);
                    mean += truth.image.plane(0, channel)[i] / 1024.0;
                }
                const auto [gap, error] = test::estimate(gaps);
                EXPECT_NEAR(gap, 0.0, test::z_limit(confidence, 16) * error + 0.003 * mean)
                    << method << ", channel " << channel << ", g " << g;
            }
        }
    }
}

/// Single scattering in a sphere of fog, by quadrature through the voxels.
class SphereTest : public testing::Test {
  protected:
    static constexpr double radius = 0.5, voxel = 1.0 / 48.0, extinction = 3.0;
    static constexpr float g = 0.6f, irradiance = 2.0f;
    static constexpr double albedo = 0.8;

    SphereTest() {
        const auto grid = openvdb::FloatGrid::create(0.0f);
        constexpr int reach = 27;
        for (int x = -reach; x <= reach; ++x) {
            for (int y = -reach; y <= reach; ++y) {
                for (int z = -reach; z <= reach; ++z) {
                    // A face one voxel wide.
                    const double gap = radius / voxel - std::sqrt(double(x * x + y * y + z * z));
                    const double value = std::clamp(gap + 0.5, 0.0, 1.0);
                    if (value > 0.0) {
                        grid->tree().setValue(Coord(x, y, z), static_cast<float>(value));
                    }
                }
            }
        }
        grid->setTransform(openvdb::math::Transform::createLinearTransform(voxel));
        volume_ = test::volume_of(grid);
    }

    /// A pinhole of a camera whose one view passes the centre at this distance.
    Scene scene(double impact) const {
        const Camera camera(V3d(impact, 0.1, 3.0), V3d(impact, 0.1, 0.0), V3d(0.0, 1.0, 0.0), 1e-4);
        return test::make_scene(volume_, camera,
                                {make_distant_light(V3f(light_), Color(irradiance), 0.0f)},
                                {float(extinction), Color(float(albedo)), g, 16, 16});
    }

    /// Eq. 1's integral along that view, with N octaves of a look; by the voxels' exact optical
    /// depth, or for a true sphere.
    double expected(double impact, int octaves, const Look& look, bool true_sphere) const {
        const V3d origin(impact, 0.1, 3.0), view(0.0, 0.0, -1.0), to_light = -light_;
        const HenyeyGreenstein phase(g);
        constexpr int steps = 400;
        constexpr double first = 2.3, last = 3.7, width = (last - first) / steps;
        double radiance = 0.0, depth = 0.0;
        for (int i = 0; i < steps; ++i) {
            const double t = first + (i + 0.5) * width;
            const V3d x = origin + view * t;
            const double along = true_sphere ? (x.length() < radius ? width : 0.0)
                                             : tau(origin, view, t - 0.5 * width, t + 0.5 * width);
            if (along <= 0.0) continue;
            const double b = x.dot(to_light);
            const double chord = -b + std::sqrt(std::max(0.0, b * b + radius * radius - x.dot(x)));
            const double shadow = extinction * (true_sphere ? chord : tau(x, to_light, 0.0, 2.0));
            double light = 0.0;
            for (int k = 0; k < octaves; ++k) {
                const HenyeyGreenstein lobe(float(std::pow(look.c, k)) * g);
                light += std::pow(look.b, k) * lobe.density(V3f(view), V3f(to_light)) *
                         std::exp(-std::pow(look.a, k) * shadow);
            }
            const double here = extinction * along;
            radiance += std::exp(-depth) * -std::expm1(-here) * albedo * irradiance * light;
            depth += here;
        }
        return radiance;
    }

    double tau(const V3d& from, const V3d& along, double begin, double end) const {
        V3d direction;
        volume_->world_to_local().multDirMatrix(along, direction);
        return test::optical_depth(volume_->tree(), from * volume_->world_to_local(), direction,
                                   begin, end);
    }

    const V3d light_ = V3d(-1.0, -0.3, -0.4).normalized();
    std::shared_ptr<const Volume> volume_;
    static constexpr std::array<double, 3> impacts{0.0, 0.2, -0.35};
};

TEST_F(SphereTest, SingleScatteringEqualsQuadrature) {
    for (const double impact : impacts) {
        const double truth = expected(impact, 1, {"physical"}, false);
        EXPECT_NEAR(truth, expected(impact, 1, {"physical"}, true), 0.01 * truth);
        for (const char* method : {"single", "reference", "multiple", "density"}) {
            const auto [mean, error] = test::estimate(
                test::render_whole(scene(impact), test::transport_of(method, 1), 256), Partial::g);
            EXPECT_LT(error, 0.01 * truth);
            // All but `reference` march, with the step's bias.
            const double bias = std::string(method) == "reference" ? 1e-4 : 1e-3;
            EXPECT_NEAR(mean, truth, test::z_limit(confidence, 12) * error + bias * truth)
                << method << " at " << impact;
        }
    }
}

TEST_F(SphereTest, ContrastSumsItsOctaves) {
    const Look look{"look", 0.5f, 0.6f, 0.4f};
    for (const double impact : impacts) {
        for (const int octaves : {2, 8}) {
            const double truth = expected(impact, octaves, look, false);
            const auto [mean, error] = test::estimate(
                test::render_whole(scene(impact), test::transport_of("contrast", octaves, {look}),
                                   256),
                Partial::g);
            EXPECT_LT(error, 0.005 * truth);
            EXPECT_NEAR(mean, truth, test::z_limit(confidence, 6) * error + 1e-3 * truth)
                << octaves << " octaves at " << impact;
        }
    }
}

TEST(BeerLambert, AlphaAndBackgroundAreThoseOfTheExactOpticalDepth) {
    // A rough field without scattering, before a dome of radiance 2: A is 1 - T and the image 2 T.
    const auto volume = test::volume_of(test::noise_grid(24, 12, 0.05));
    const Camera camera(V3d(-2.0, 0.61, 0.83), V3d(0.6, 0.47, 0.52), V3d(0.0, 1.0, 0.0), 1e-4);
    const Scene scene = test::make_scene(volume, camera, {test::constant_dome(2.0f)},
                                         {1.5f, Color(0.0f), 0.0f, 16, 16});
    V3d direction;
    volume->world_to_local().multDirMatrix(camera.forward(), direction);
    const double depth =
        1.5 * test::optical_depth(volume->tree(), camera.position() * volume->world_to_local(),
                                  direction, 0.0, 10.0);
    ASSERT_GT(depth, 0.3);
    ASSERT_LT(depth, 3.0);
    for (const char* method : {"single", "contrast", "multiple", "density", "reference"}) {
        const Partial partial = test::render_whole(scene, test::transport_of(method, 1), 256);
        const auto alpha = test::estimate(partial, Partial::a);
        EXPECT_LT(alpha.error, 2e-3);
        // A march errs by its steps, each of which reads a rough field once.
        const double bias = method == std::string("reference") ? 5e-4 : 6e-4;
        EXPECT_NEAR(alpha.mean, -std::expm1(-depth),
                    test::z_limit(confidence, 10) * alpha.error + bias)
            << method;
        const auto seen = test::estimate(partial, Partial::g);
        EXPECT_NEAR(seen.mean, 2.0 * std::exp(-depth),
                    test::z_limit(confidence, 10) * seen.error + 2.0 * bias)
            << method;
    }
}

}  // namespace
}  // namespace pileus
