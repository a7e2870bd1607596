// A frame to be rendered, resolved to plain values: what there is, how light moves through it, and
// which pixels there are.
#pragma once

#include "camera.h"
#include "light.h"
#include "medium.h"

#include <memory>
#include <optional>
#include <string>
#include <vector>

namespace pileus {

/// A rectangle of pixels, half-open; y runs down.
struct Bucket {
    int x0, y0, x1, y1;
    int width() const { return x1 - x0; }
    int height() const { return y1 - y0; }
    std::size_t pixels() const {
        return static_cast<std::size_t>(width()) * static_cast<std::size_t>(height());
    }
    auto operator<=>(const Bucket&) const = default;
};

/// The artist's grip on Eq. 1 of the talk: order i sees the light through exp(-a^i tau), weighs
/// b^i, and scatters it with anisotropy c^i g. All in [0, 1]; 1, 1, 1 is physical.
struct Look {
    std::string name;
    float a = 1.0f, b = 1.0f, c = 1.0f;
    bool physical() const { return a == 1.0f && b == 1.0f && c == 1.0f; }
};

struct Transport {
    std::string method;
    std::optional<int> max_bounces;  // scatter events on a path; nothing: unlimited
    std::vector<Look> looks;
    int reduce_from = 3;  // `similarity`: the first event that a reduced medium leads to
};

struct Scene {
    std::shared_ptr<const Volume> volume;
    Medium medium;
    Camera camera;
    std::vector<std::shared_ptr<const Light>> lights;
    int width, height;
    bool background;  // whether rays that leave the volume see the domes

    /// What a ray sees beyond the volume.
    Color sky(const V3f& direction) const;

    /// False where no ray of the bucket can meet the volume.
    bool touches(const Bucket& bucket) const;
};

}  // namespace pileus
