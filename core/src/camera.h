// A perspective camera, inside or outside the volume. Positions are double: scenes lie far from the
// origin.
#pragma once

#include "geometry.h"

namespace pileus {

class Camera {
  public:
    /// `fov` is horizontal, in degrees. Throws InputError where these make no view.
    Camera(const V3d& position, const V3d& look_at, const V3d& up, double fov);

    const V3d& position() const { return position_; }
    const V3d& forward() const { return forward_; }

    /// The unit direction through a point of the image, in pixels from its upper left corner.
    V3d direction(double x, double y, int width, int height) const;

    /// Both as OpenEXR's standard attributes define them (ImfStandardAttributes.h): camera space is
    /// left-handed with +z ahead; NDC runs from (0, 0), upper left, to (1, 1). Row vectors.
    Imath::M44d world_to_camera() const;
    Imath::M44d world_to_ndc(int width, int height) const;

  private:
    V3d position_, forward_, right_, up_;
    double half_width_;  // of the image plane at distance 1
};

}  // namespace pileus
