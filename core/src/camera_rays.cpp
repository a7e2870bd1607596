#include "camera_rays.h"

#include <algorithm>
#include <limits>

namespace pileus {

CameraRays::CameraRays(const Scene& scene)
    : scene_(&scene),
      plane_(scene.camera.image_plane(scene.width, scene.height)),
      origin_(scene.camera.position() * scene.volume->world_to_local()),
      low_(scene.volume->tree().low()),
      high_(scene.volume->tree().high()) {
    for (int row = 0; row < 3; ++row) {
        for (int column = 0; column < 3; ++column)
            to_local_[row][column] = scene.volume->world_to_local()[row][column];
    }
}

CameraRay CameraRays::through(double x, double y) const {
    const V3d ahead = plane_.at(x, y);
    const V3d direction = ahead * (1.0 / std::sqrt(ahead.length2()));
    CameraRay ray{V3f(direction), std::nullopt, 0.0, direction.dot(scene_->camera.forward())};
    if (scene_->volume->empty()) return ray;

    // In double to the box, for the camera may be far away; from there on float serves.
    const V3d step = direction * to_local_;
    double enter = 0.0, leave = std::numeric_limits<double>::infinity();
    for (int axis = 0; axis < 3; ++axis) {
        if (step[axis] == 0.0) {
            if (origin_[axis] < low_[axis] || origin_[axis] >= high_[axis]) return ray;
            continue;
        }
        const double inverse = 1.0 / step[axis];
        const double to_low = (low_[axis] - origin_[axis]) * inverse,
                     to_high = (high_[axis] - origin_[axis]) * inverse;
        enter = std::max(enter, std::min(to_low, to_high));
        leave = std::min(leave, std::max(to_low, to_high));
    }
    if (!(enter < leave)) return ray;
    ray.entry_distance = enter;
    ray.volume = scene_->medium.ray(V3f(origin_ + step * enter), ray.direction);
    return ray;
}

}  // namespace pileus
