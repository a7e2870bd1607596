#include "texture.h"

#include "error.h"
#include "exr_file.h"
#include "printable.h"

#include <dlfcn.h>

namespace pileus {

Texture read_texture(const std::string& path) {
    using Read = void(const std::string&, Texture&, std::string&);
    static void* const library = ::dlopen("libpileus_texture.so", RTLD_NOW | RTLD_LOCAL);
    // dlerror tells its reason once.
    static const std::string reason = library ? "" : ::dlerror();
    if (!library) throw std::runtime_error(path + ": " + reason);
    check_channels(path);
    static auto* const read = reinterpret_cast<Read*>(::dlsym(library, "pileus_read_texture"));
    Texture texture;
    std::string trouble;
    read(path, texture, trouble);
    if (!trouble.empty()) throw InputError(path + ": " + printable(trouble));
    return texture;
}

}  // namespace pileus
