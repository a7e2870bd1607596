#include "camera.h"

#include "error.h"

#include <cmath>

namespace pileus {

Camera::Camera(const V3d& position, const V3d& look_at, const V3d& up, double fov)
    : position_(position) {
    if (!(fov > 0.0 && fov < 180.0))
        throw InputError("camera.fov must lie between 0 and 180 degrees");
    const V3d ahead = look_at - position;
    if (!std::isfinite(ahead.length2()) || !std::isfinite(up.length2()))
        throw InputError("camera.position, look_at and up must be within 1e150 of each other");
    if (!(ahead.length() > 0.0))
        throw InputError("camera.look_at equals camera.position; move one of them");
    forward_ = ahead.normalized();
    const V3d right = forward_.cross(up);
    if (!(right.length() > 1e-9 * up.length())) {
        throw InputError("camera.up points along the view; choose another direction");
    }
    right_ = right.normalized();
    up_ = right_.cross(forward_);
    half_width_ = std::tan(0.5 * fov * std::numbers::pi / 180.0);
}

ImagePlane Camera::image_plane(int width, int height) const {
    const double pixel = 2.0 * half_width_ / width;
    return {forward_ - right_ * half_width_ + up_ * (0.5 * pixel * height), right_ * pixel,
            -up_ * pixel};
}

Imath::M44d Camera::world_to_camera() const {
    const V3d t(-position_.dot(right_), -position_.dot(up_), -position_.dot(forward_));
    return {right_.x, up_.x, forward_.x, 0.0, right_.y, up_.y, forward_.y, 0.0,
            right_.z, up_.z, forward_.z, 0.0, t.x,      t.y,   t.z,        1.0};
}

Imath::M44d Camera::world_to_ndc(int width, int height) const {
    // w = z; x_ndc = (x / (z half_width) + 1) / 2, and y likewise, downwards.
    const double sx = 0.5 / half_width_;
    const double sy = -0.5 / (half_width_ * height / width);
    const Imath::M44d projection(sx, 0.0, 0.0, 0.0, 0.0, sy, 0.0, 0.0, 0.5, 0.5, 1.0, 1.0, 0.0, 0.0,
                                 0.0, 0.0);
    return world_to_camera() * projection;
}

}  // namespace pileus
