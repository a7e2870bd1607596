// OpenEXR files of float and half layers, one part a look: written whole or not at all, read with
// every sample checked to be there.
#pragma once

#include "geometry.h"
#include "scene.h"

#include <map>
#include <string>
#include <utility>
#include <variant>
#include <vector>

namespace pileus {

/// A header value: text, float, rational (frames per second) or a 4x4 matrix for row vectors.
using HeaderValue = std::variant<std::string, float, std::pair<int, unsigned>, Imath::M44f>;
using Header = std::map<std::string, HeaderValue>;

/// A rectangle of pixels with the same float channels for each of some looks.
class LayeredImage {
  public:
    LayeredImage() = default;
    LayeredImage(const Bucket& window, std::vector<std::string> looks,
                 std::vector<std::string> channels);

    const Bucket& window() const { return window_; }
    const std::vector<std::string>& looks() const { return looks_; }
    const std::vector<std::string>& channels() const { return channels_; }

    /// `pixels()` values, row by row from the top.
    float* plane(std::size_t look, std::size_t channel) {
        return data_.data() + offset(look, channel);
    }
    const float* plane(std::size_t look, std::size_t channel) const {
        return data_.data() + offset(look, channel);
    }

    const std::vector<float>& data() const { return data_; }

    /// Throws InputError where there is no such look.
    std::size_t look_index(const std::string& name) const;

  private:
    std::size_t offset(std::size_t look, std::size_t channel) const {
        return (look * channels_.size() + channel) * window_.pixels();
    }

    Bucket window_{};
    std::vector<std::string> looks_, channels_;
    std::vector<float> data_;
};

/// Writes the image, its display window width x height, into a temporary file beside `path`, syncs
/// it and renames it. With `half`, all channels but Z and the variances are half. Throws
/// std::runtime_error.
void write_exr(const std::string& path, const LayeredImage& image, int width, int height, bool half,
               const Header& header);

struct ExrFile {
    LayeredImage image;
    int width = 0, height = 0;
    std::map<std::string, std::string> text;  // the header's text values
};

/// Reads what `write_exr` wrote, and other multi-part scanline files whose parts have the same
/// channels. Throws InputError, naming the file.
ExrFile read_exr(const std::string& path);

/// Throws InputError for an OpenEXR file with a channel of no known kind, at which OpenImageIO ends
/// the process. Other files pass.
void check_channels(const std::string& path);

}  // namespace pileus
