// What the core's tests share: grids written to disk and read as volumes, small scenes, the exact
// optical depth of a trilinear field, and the limits that statistical tests compare against.
#pragma once

#include "brick_tree.h"
#include "render.h"

#include <openvdb/openvdb.h>

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <functional>
#include <memory>
#include <string>
#include <unistd.h>
#include <vector>

namespace pileus::test {

/// A folder of one test's own, gone with it.
class TemporaryFolder {
  public:
    TemporaryFolder() {
        static int count = 0;
        folder_ = std::filesystem::temp_directory_path() /
                  ("pileus-test-" + std::to_string(::getpid()) + "-" + std::to_string(count++));
        std::filesystem::create_directories(folder_);
    }
    TemporaryFolder(const TemporaryFolder&) = delete;
    TemporaryFolder& operator=(const TemporaryFolder&) = delete;
    ~TemporaryFolder() { std::filesystem::remove_all(folder_); }

    std::string path(const std::string& name) const { return (folder_ / name).string(); }

  private:
    std::filesystem::path folder_;
};

inline std::string write_grids(const std::string& path, const openvdb::GridPtrVec& grids) {
    openvdb::initialize();
    openvdb::io::File(path).write(grids);
    return path;
}

/// The grid as the renderer reads it from disk.
inline std::shared_ptr<const Volume> volume_of(const openvdb::FloatGrid::Ptr& grid) {
    const TemporaryFolder folder;
    grid->setName("density");
    return std::make_shared<const Volume>(write_grids(folder.path("grid.vdb"), {grid}), "density");
}

/// Ones in a box of voxels: interpolated, the field is 1 inside and falls to 0 over the voxel that
/// surrounds it. Its integral along an axis through it is the number of voxels.
inline openvdb::FloatGrid::Ptr box_grid(const openvdb::Coord& size, const openvdb::Vec3d& voxel) {
    openvdb::initialize();
    auto grid = openvdb::FloatGrid::create(0.0f);
    grid->sparseFill(openvdb::CoordBBox(openvdb::Coord(0), size.offsetBy(-1)), 1.0f);
    auto transform = openvdb::math::Transform::createLinearTransform();
    // Centred on the origin of the world.
    transform->preScale(voxel);
    transform->preTranslate(-0.5 * (size.asVec3d() - openvdb::Vec3d(1.0)));
    grid->setTransform(transform);
    return grid;
}

/// Independent uniform values in (0, 1] in a cube of voxels: the roughest field there is.
inline openvdb::FloatGrid::Ptr noise_grid(int width, std::uint64_t key, double voxel) {
    openvdb::initialize();
    auto grid = openvdb::FloatGrid::create(0.0f);
    Random random(key);
    for (int x = 0; x < width; ++x) {
        for (int y = 0; y < width; ++y) {
            for (int z = 0; z < width; ++z) {
                grid->tree().setValue(openvdb::Coord(x, y, z), 1.0f - random.uniform());
            }
        }
    }
    grid->setTransform(openvdb::math::Transform::createLinearTransform(voxel));
    return grid;
}

/// The field at x, from the eight voxels around it, in double. `cell` decides on which side of a
/// face x is.
inline double trilinear(const BrickTree& tree, const V3d& x, const V3i& cell) {
    double sum = 0.0;
    for (int corner = 0; corner < 8; ++corner) {
        const V3i offset(corner >> 2, corner >> 1 & 1, corner & 1);
        double weight = 1.0;
        for (int axis = 0; axis < 3; ++axis) {
            const double f = x[axis] - cell[axis];
            weight *= offset[axis] ? f : 1.0 - f;
        }
        sum += weight * tree.voxel(cell + offset);
    }
    return sum;
}

inline V3i cell_of(const V3d& x) {
    return {static_cast<int>(std::floor(x.x)), static_cast<int>(std::floor(x.y)),
            static_cast<int>(std::floor(x.z))};
}

/// The integral of the interpolated field over [begin, end] of a local ray. In each voxel cell the
/// field along a ray is a cubic polynomial, which Simpson's rule integrates exactly.
inline double optical_depth(const BrickTree& tree, const V3d& origin, const V3d& direction,
                            double begin, double end) {
    std::vector<double> cuts{begin, end};
    for (int axis = 0; axis < 3; ++axis) {
        const double d = direction[axis];
        if (std::abs(d) < 1e-12) continue;
        const double a = origin[axis] + d * begin, b = origin[axis] + d * end;
        const double first = std::max(std::min(a, b), double(tree.low()[axis]));
        const double last = std::min(std::max(a, b), double(tree.high()[axis]));
        for (double plane = std::ceil(first); plane <= last; plane += 1.0) {
            cuts.push_back(std::clamp((plane - origin[axis]) / d, begin, end));
        }
    }
    std::sort(cuts.begin(), cuts.end());
    double depth = 0.0;
    for (std::size_t i = 0; i + 1 < cuts.size(); ++i) {
        const double width = cuts[i + 1] - cuts[i];
        if (width <= 0.0) continue;
        const auto at = [&](double t) { return origin + direction * t; };
        const double middle = cuts[i] + 0.5 * width;
        const V3i cell = cell_of(at(middle));
        depth += width / 6.0 *
                 (trilinear(tree, at(cuts[i]), cell) + 4.0 * trilinear(tree, at(middle), cell) +
                  trilinear(tree, at(cuts[i + 1]), cell));
    }
    return depth;
}

/// The point below which a standard normal variable lies with this probability.
inline double normal_quantile(double probability) {
    double low = -40.0, high = 40.0;
    for (int i = 0; i < 200; ++i) {
        const double middle = 0.5 * (low + high);
        (0.5 * std::erfc(-middle / std::sqrt(2.0)) < probability ? low : high) = middle;
    }
    return low;
}

/// How many standard errors the worst of several independent estimates may be off, either way, at a
/// confidence for all of them together (Sidak 1967).
inline double z_limit(double confidence, int tests = 1) {
    return normal_quantile(0.5 + 0.5 * std::pow(confidence, 1.0 / tests));
}

/// The same for a chi-square statistic (Wilson & Hilferty 1931).
inline double chi_square_limit(double confidence, int freedom, int tests = 1) {
    const double z = normal_quantile(std::pow(confidence, 1.0 / tests));
    const double k = 2.0 / (9.0 * freedom);
    return freedom * std::pow(1.0 - k + z * std::sqrt(k), 3.0);
}

/// The mean of independent values and its standard error.
struct Estimate {
    double mean = 0.0, error = 0.0;
};

inline Estimate estimate(const std::vector<double>& values) {
    const double n = static_cast<double>(values.size());
    double sum = 0.0, squares = 0.0;
    for (const double value : values) sum += value;
    const double mean = sum / n;
    for (const double value : values) squares += (value - mean) * (value - mean);
    return {mean, std::sqrt(squares / (n * (n - 1.0)))};
}

/// Pixels are keyed apart, so their values are independent, as the stratified samples of one pixel
/// are not.
inline Estimate estimate(const Partial& partial, std::size_t channel, std::size_t look = 0) {
    const float* const plane = partial.image.plane(look, channel);
    return estimate(std::vector<double>(plane, plane + partial.image.window().pixels()));
}

struct SceneOptions {
    float extinction = 1.0f;
    Color albedo{1.0f};
    float anisotropy = 0.0f;
    int width = 16, height = 16;
    bool background = true;
};

inline Scene make_scene(std::shared_ptr<const Volume> volume, const Camera& camera,
                        std::vector<std::shared_ptr<const Light>> lights,
                        const SceneOptions& options) {
    const Medium medium(*volume, options.extinction, options.albedo, options.anisotropy);
    return {std::move(volume), medium, camera, std::move(lights), options.width, options.height,
            options.background};
}

inline std::shared_ptr<const Light> constant_dome(float radiance = 1.0f) {
    std::vector<std::string> warnings;
    return make_dome_light(Color(radiance), "", warnings);
}

inline Transport transport_of(const std::string& method, std::optional<int> max_bounces = {},
                              std::vector<Look> looks = {{"physical"}}) {
    return resolve({method, max_bounces, std::move(looks)});
}

inline Partial render_whole(const Scene& scene, const Transport& transport, int samples,
                            bool orders = false, int threads = 0) {
    Control control;
    return render(scene, transport,
                  {{0, 0, scene.width, scene.height},
                   {0, samples},
                   11,
                   1,
                   orders ? *transport.max_bounces : 0},
                  threads, control);
}

}  // namespace pileus::test
