// Text from a file or a library, fit for an error's one line.
#pragma once

#include <cstdio>
#include <string>

namespace pileus {

/// Text as one line that no terminal obeys and any reader of UTF-8 takes: what a file put into a
/// message is shown escaped where it is not that.
inline std::string printable(const std::string& text) {
    std::string line;
    for (std::size_t i = 0; i < text.size();) {
        const auto byte = [&](std::size_t at) { return static_cast<unsigned char>(text[at]); };
        const unsigned char first = byte(i);
        const std::size_t more = first < 0x80 ? 0 : first < 0xe0 ? 1 : first < 0xf0 ? 2 : 3;
        bool good = first >= 0x20 && first < 0x7f;
        if (first >= 0xc3 && first < 0xf4 && i + more < text.size()) {
            good = true;
            for (std::size_t k = 1; k <= more; ++k) good = good && (byte(i + k) & 0xc0) == 0x80;
            // Not the long forms of short codes, nor the halves of UTF-16's pairs.
            good = good && !(first == 0xe0 && byte(i + 1) < 0xa0) &&
                   !(first == 0xed && byte(i + 1) >= 0xa0) &&
                   !(first == 0xf0 && byte(i + 1) < 0x90);
        }
        if (good) {
            line.append(text, i, more + 1);
            i += more + 1;
        } else {
            char escaped[5];
            std::snprintf(escaped, sizeof escaped, "\\x%02x", first);
            line += escaped;
            ++i;
        }
    }
    return line;
}

}  // namespace pileus
