// Checks what a maker was asked for.
#include "options.h"

#include <stdexcept>
#include <string>

namespace pileus {

void validate(const MakeOptions& options) {
    if (options.resolution < 8 || options.resolution > 4096) {
        throw std::invalid_argument("resolution " + std::to_string(options.resolution) +
                                    ": must be from 8 to 4096 voxels per world unit");
    }
    if (options.frames < 1) {
        throw std::invalid_argument("frames " + std::to_string(options.frames) +
                                    ": must be 1 or more");
    }
    if (options.frame < 1) {
        throw std::invalid_argument("frame " + std::to_string(options.frame) +
                                    ": must be 1 or more");
    }
}

}  // namespace pileus
