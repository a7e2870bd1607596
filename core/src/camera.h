// A perspective camera, inside or outside the volume. Positions are double: scenes lie far from the
// origin.
#pragma once

#include "geometry.h"

namespace pileus {

/// The points of an image in the plane at distance 1 before a camera, seen from it.
struct ImagePlane {
    V3d corner, across, down;  // the upper left corner, and the ways to the next pixels

    /// `x` and `y` in pixels from the upper left corner.
    V3d at(double x, double y) const { return corner + across * x + down * y; }
};

class Camera {
  public:
    /// `fov` is horizontal, in degrees. Throws InputError where these make no view.
    Camera(const V3d& position, const V3d& look_at, const V3d& up, double fov);

    const V3d& position() const { return position_; }
    const V3d& forward() const { return forward_; }

    ImagePlane image_plane(int width, int height) const;

    /// Both as OpenEXR's standard attributes define them (ImfStandardAttributes.h): camera space is
    /// left-handed with +z ahead; NDC runs from (0, 0), upper left, to (1, 1). Row vectors.
    Imath::M44d world_to_camera() const;
    Imath::M44d world_to_ndc(int width, int height) const;

  private:
    V3d position_, forward_, right_, up_;
    double half_width_;  // of the image plane at distance 1
};

}  // namespace pileus
