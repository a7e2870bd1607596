#include "brick_tree.h"

namespace pileus {

float BrickTree::interpolate(const V3f& x) const {
    const V3i base(floor_int(x.x), floor_int(x.y), floor_int(x.z));
    const V3f f(x.x - static_cast<float>(base.x), x.y - static_cast<float>(base.y),
                x.z - static_cast<float>(base.z));
    constexpr int last = width - 1;
    std::array<float, 8> v;

    const bool inside_one =
        (base.x & last) != last && (base.y & last) != last && (base.z & last) != last;
    if (inside_one && contains(base)) {
        const Child found = descend(base);
        if (found & constant_bit) return scale_ * decode_half(static_cast<Half>(found));
        const Half* const corner = &bricks_[found][entry(base, 0)];
        constexpr int step_x = width * width, step_y = width;
        v = {decode_half(corner[0]),
             decode_half(corner[1]),
             decode_half(corner[step_y]),
             decode_half(corner[step_y + 1]),
             decode_half(corner[step_x]),
             decode_half(corner[step_x + 1]),
             decode_half(corner[step_x + step_y]),
             decode_half(corner[step_x + step_y + 1])};
        for (float& value : v) value *= scale_;
    } else {
        for (int i = 0; i < 8; ++i) {
            v[static_cast<unsigned>(i)] = voxel(base + V3i(i >> 2, (i >> 1) & 1, i & 1));
        }
    }
    const auto mix = [](float a, float b, float t) { return a + (b - a) * t; };
    const float x0 = mix(mix(v[0], v[1], f.z), mix(v[2], v[3], f.z), f.y);
    const float x1 = mix(mix(v[4], v[5], f.z), mix(v[6], v[7], f.z), f.y);
    return mix(x0, x1, f.x);
}

}  // namespace pileus
