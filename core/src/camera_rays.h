// The camera's rays through the points of an image, as the volume's box meets them.
#pragma once

#include "camera.h"
#include "majorants.h"
#include "scene.h"

#include <optional>

namespace pileus {

/// A ray through a point of the image: where it enters the volume's box, if it does.
struct CameraRay {
    V3f direction;  // world, unit
    std::optional<LocalRay> volume;
    double entry_distance;      // world units from the camera to the local ray's origin
    double depth_per_distance;  // along the view axis
};

class CameraRays {
  public:
    /// The scene must outlive them.
    explicit CameraRays(const Scene& scene);

    /// `x` and `y` in pixels from the image's upper left corner.
    CameraRay through(double x, double y) const;

  private:
    const Scene* scene_;
    ImagePlane plane_;
    Imath::M33d to_local_;     // of directions
    V3d origin_, low_, high_;  // the camera and the volume's box, local
};

}  // namespace pileus
