// Images as textures. OpenImageIO reads them, and brings some two hundred libraries along: it lives
// in a library of its own that is loaded only when there is a texture to read.
#pragma once

#include <string>
#include <vector>

namespace pileus {

/// Pixels row by row from the top, `channels` values each: 1, grey, or 3.
struct Texture {
    int width = 0, height = 0, channels = 0;
    std::vector<float> values;
};

/// Reads a plain image of at most 2^28 pixels, without its alpha. Throws InputError, naming the
/// file.
Texture read_texture(const std::string& path);

}  // namespace pileus
