// The first scatter event of a camera ray by density sampling, as `single`, `contrast`, `multiple`
// and `density` share it.
#pragma once

#include "../camera_rays.h"
#include "../march.h"
#include "../path.h"
#include "../scene.h"

#include <optional>

namespace pileus {

/// Marches the camera ray and draws its first event. The event always lies in the medium; its
/// weight is the opacity of the ray times the albedo. Nothing where the ray meets no density.
inline std::optional<ScatterEvent> first_event(const Scene& scene, const CameraRay& ray,
                                               const PathRandom& random, Random& walk,
                                               DensityMarch& march, PathRecord& record) {
    march.march(scene.medium, *ray.volume, walk.uniform());
    record.opacity = march.opacity();
    if (record.opacity <= 0.0f) return std::nullopt;
    const float distance = march.invert(random.first[2]);
    record.depth = (ray.entry_distance + distance) * ray.depth_per_distance;
    return ScatterEvent{ray.volume->at(distance), ray.direction,
                        scene.medium.albedo() * record.opacity};
}

}  // namespace pileus
