#include "scene.h"

#include <algorithm>

namespace pileus {

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
    const ImagePlane plane = camera.image_plane(width, height);
    const V3d rays[] = {plane.at(bucket.x0, bucket.y0), plane.at(bucket.x1, bucket.y0),
                        plane.at(bucket.x1, bucket.y1), plane.at(bucket.x0, bucket.y1)};
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
