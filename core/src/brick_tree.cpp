#include "brick_tree.h"

namespace pileus {

float BrickTree::interpolate(const V3f& x, Cursor& cursor) const {
    const V3i base(floor_int(x.x), floor_int(x.y), floor_int(x.z));
    const V3f f(x.x - static_cast<float>(base.x), x.y - static_cast<float>(base.y),
                x.z - static_cast<float>(base.z));
    constexpr int last = width - 1;
    const V3i low(base.x & ~last, base.y & ~last, base.z & ~last);
    if (low != cursor.low) cursor = {low, contains(base) ? descend(base) : constant(0)};

    std::array<float, 8> v;
    const unsigned straddled = ((base.x & last) == last ? 4u : 0u) |
                               ((base.y & last) == last ? 2u : 0u) |
                               ((base.z & last) == last ? 1u : 0u);
    if (straddled == 0) {
        if (cursor.found & constant_bit)
            return scale_ * decode_half(static_cast<Half>(cursor.found));
        const Half* const corner = &bricks_[cursor.found][entry(base, 0)];
        for (unsigned i = 0; i < 8; ++i) {
            v[i] = decode_half(corner[(i >> 2) * width * width + ((i >> 1) & 1) * width + (i & 1)]);
        }
    } else {
        // The cell lies across faces of bricks: up to eight hold its voxels, with one descent for
        // each.
        std::array<Child, 8> found;
        for (unsigned m = straddled; m != 0; m = (m - 1) & straddled) {
            const V3i at = base + V3i(m >> 2, (m >> 1) & 1, m & 1);
            found[m] = contains(at) ? descend(at) : constant(0);
        }
        found[0] = cursor.found;
        for (unsigned i = 0; i < 8; ++i) {
            const V3i at = base + V3i(i >> 2, (i >> 1) & 1, i & 1);
            const Child child = found[i & straddled];
            v[i] = decode_half(child & constant_bit ? static_cast<Half>(child)
                                                    : bricks_[child][entry(at, 0)]);
        }
    }
    const auto mix = [](float a, float b, float t) { return a + (b - a) * t; };
    const float x0 = mix(mix(v[0], v[1], f.z), mix(v[2], v[3], f.z), f.y);
    const float x1 = mix(mix(v[4], v[5], f.z), mix(v[6], v[7], f.z), f.y);
    return scale_ * mix(x0, x1, f.x);
}

}  // namespace pileus
