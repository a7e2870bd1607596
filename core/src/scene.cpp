#include "scene.h"

#include <algorithm>

namespace pileus {

CameraRay Scene::camera_ray(double x, double y) const {
    const V3d direction = camera.direction(x, y, width, height);
    CameraRay ray{V3f(direction), std::nullopt, 0.0, direction.dot(camera.forward())};
    if (volume->empty()) return ray;

    // In double to the box, for the camera may be far away; from there on float serves.
    const V3d origin = camera.position() * volume->world_to_local();
    V3d step;
    volume->world_to_local().multDirMatrix(direction, step);
    double enter = 0.0, leave = std::numeric_limits<double>::infinity();
    for (int axis = 0; axis < 3; ++axis) {
        const double low = volume->tree().low()[axis], high = volume->tree().high()[axis];
        if (step[axis] == 0.0) {
            if (origin[axis] < low || origin[axis] >= high) return ray;
            continue;
        }
        const double to_low = (low - origin[axis]) / step[axis],
                     to_high = (high - origin[axis]) / step[axis];
        enter = std::max(enter, std::min(to_low, to_high));
        leave = std::min(leave, std::max(to_low, to_high));
    }
    if (!(enter < leave)) return ray;
    ray.entry_distance = enter;
    ray.volume = medium.ray(V3f(origin + step * enter), ray.direction);
    return ray;
}

Color Scene::sky(const V3f& direction) const {
    Color color(0.0f);
    for (const auto& light : lights) {
        if (light->can_be_hit()) color += light->radiance(direction);
    }
    return color;
}

bool Scene::touches(const Bucket& bucket) const {
    if (volume->empty()) return false;
    // The box misses the bucket's pyramid if all its corners lie beyond one of the pyramid's
    // planes.
    std::vector<V3d> corners;
    const V3i& low = volume->tree().low();
    const V3i& high = volume->tree().high();
    for (int i = 0; i < 8; ++i) {
        const V3d local(i & 1 ? high.x : low.x, i & 2 ? high.y : low.y, i & 4 ? high.z : low.z);
        corners.push_back(local * volume->local_to_world() - camera.position());
    }
    const auto corner_ray = [&](int x, int y) { return camera.direction(x, y, width, height); };
    const V3d rays[] = {corner_ray(bucket.x0, bucket.y0), corner_ray(bucket.x1, bucket.y0),
                        corner_ray(bucket.x1, bucket.y1), corner_ray(bucket.x0, bucket.y1)};
    const V3d centre = rays[0] + rays[1] + rays[2] + rays[3];
    const auto beyond = [&](V3d normal) {
        if (normal.dot(centre) < 0.0) normal = -normal;
        return std::all_of(corners.begin(), corners.end(),
                           [&](const V3d& c) { return normal.dot(c) < 0.0; });
    };
    for (int side = 0; side < 4; ++side) {
        if (beyond(rays[side].cross(rays[(side + 1) % 4]))) return false;
    }
    return !beyond(camera.forward());
}

}  // namespace pileus
