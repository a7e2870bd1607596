// A target for libFuzzer: whatever an image file holds, it is read, or refused in one line, in the
// memory that a render child may have. `tests/security/test_fuzz.py` builds it and runs it.
#include "error.h"
#include "exr_file.h"
#include "partial.h"
#include "texture.h"

#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <new>
#include <string>
#include <sys/resource.h>
#include <unistd.h>

namespace {

template <class Read>
void expect_read_or_refused(const Read& read) {
    try {
        read();
    } catch (const pileus::InputError& error) {
        for (const unsigned char c : std::string(error.what())) {
            if (c < ' ' || c == 0x7f) std::abort();
        }
    } catch (const std::bad_alloc&) {
        // As the child's limit would have it.
    }
}

}  // namespace

extern "C" int LLVMFuzzerInitialize(int*, char***) {
    const rlimit limit{rlim_t{1} << 30, rlim_t{1} << 30};
    return ::setrlimit(RLIMIT_AS, &limit);
}

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
    static const std::string path = "fuzzed." + std::to_string(::getpid()) + ".exr";
    std::ofstream(path, std::ios::binary)
        .write(reinterpret_cast<const char*>(data), static_cast<std::streamsize>(size));
    expect_read_or_refused([] { pileus::read_texture(path); });
    expect_read_or_refused([] { pileus::read_exr(path); });
    expect_read_or_refused([] { pileus::Partial::read(path); });
    std::remove(path.c_str());
    return 0;
}
