// The library that `read_texture` loads: OpenImageIO behind one function.
#include "../texture.h"

#include <OpenImageIO/imageio.h>

#include <cstdint>

/// Reads into `texture`, or says in `trouble` why it cannot: exceptions must not cross the border.
extern "C" void pileus_read_texture(const std::string& path, pileus::Texture& texture,
                                    std::string& trouble) {
    const auto input = OIIO::ImageInput::open(path);
    if (!input) {
        trouble = "cannot be read as an image (" + OIIO::geterror() + ")";
        return;
    }
    const OIIO::ImageSpec& spec = input->spec();
    if (spec.width < 1 || spec.height < 1 || spec.nchannels < 1 ||
        std::int64_t{spec.width} * spec.height > (1 << 28)) {
        trouble = "is not a lat-long image of at most 2^28 pixels";
        return;
    }
    if (spec.depth > 1 || spec.deep) {
        trouble = "is a volume or has deep pixels; a sky is a plain image";
        return;
    }
    // What is not RGB is grey, perhaps with an alpha.
    texture = {spec.width, spec.height, spec.nchannels < 3 ? 1 : 3, {}};
    texture.values.resize(static_cast<std::size_t>(spec.width) *
                          static_cast<std::size_t>(spec.height) *
                          static_cast<std::size_t>(texture.channels));
    if (!input->read_image(0, 0, 0, texture.channels, OIIO::TypeDesc::FLOAT,
                           texture.values.data())) {
        trouble = "cannot be read whole (" + input->geterror() + ")";
    }
}
