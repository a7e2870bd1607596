#include "exr_file.h"

#include "error.h"
#include "printable.h"
#include "whole_file.h"

#include <OpenEXR/ImfChannelList.h>
#include <OpenEXR/ImfFloatAttribute.h>
#include <OpenEXR/ImfFrameBuffer.h>
#include <OpenEXR/ImfFramesPerSecond.h>
#include <OpenEXR/ImfHeader.h>
#include <OpenEXR/ImfInputPart.h>
#include <OpenEXR/ImfMatrixAttribute.h>
#include <OpenEXR/ImfMultiPartInputFile.h>
#include <OpenEXR/ImfMultiPartOutputFile.h>
#include <OpenEXR/ImfOutputPart.h>
#include <OpenEXR/ImfPartType.h>
#include <OpenEXR/ImfRationalAttribute.h>
#include <OpenEXR/ImfStringAttribute.h>
#include <OpenEXR/ImfTestFile.h>

#include <algorithm>
#include <filesystem>

namespace pileus {

namespace {

constexpr float greatest_half = 65504.0f;

bool stays_float(const std::string& channel) {
    return channel == "Z" || channel.starts_with("variance.");
}

void set_attribute(Imf::Header& header, const std::string& name, const HeaderValue& value) {
    struct Visitor {
        Imf::Header& header;
        const char* name;
        void operator()(const std::string& text) const {
            header.insert(name, Imf::StringAttribute(text));
        }
        void operator()(float number) const { header.insert(name, Imf::FloatAttribute(number)); }
        void operator()(const std::pair<int, unsigned>& ratio) const {
            // 23.976 stands for 24000/1001.
            const Imf::Rational rate(ratio.first, ratio.second);
            header.insert(name, Imf::RationalAttribute(Imf::guessExactFps(rate)));
        }
        void operator()(const Imath::M44f& matrix) const {
            header.insert(name, Imf::M44fAttribute(matrix));
        }
    };
    std::visit(Visitor{header, name.c_str()}, value);
}

/// OpenEXR's frame buffers address pixels from the data window's origin, which may lie before the
/// data.
template <class Sample>
char* origin_of(Sample* first, const Bucket& window) {
    // Unsigned, so that an origin far away wraps around and back.
    const std::uintptr_t offset =
        static_cast<std::uintptr_t>(window.y0) * static_cast<std::uintptr_t>(window.width()) +
        static_cast<std::uintptr_t>(window.x0);
    return reinterpret_cast<char*>(reinterpret_cast<std::uintptr_t>(first) -
                                   offset * sizeof(Sample));
}

template <class Sample>
Imf::Slice slice(Imf::PixelType type, const Sample* first, const Bucket& window) {
    return {type, origin_of(const_cast<Sample*>(first), window), sizeof(Sample),
            sizeof(Sample) * static_cast<std::size_t>(window.width())};
}

Imath::Box2i box_of(const Bucket& b) { return {{b.x0, b.y0}, {b.x1 - 1, b.y1 - 1}}; }

void write_parts(const std::string& path, const LayeredImage& image, int width, int height,
                 bool half, const Header& attributes) {
    std::vector<Imf::Header> headers;
    for (const std::string& look : image.looks()) {
        Imf::Header header(Imath::Box2i({0, 0}, {width - 1, height - 1}), box_of(image.window()));
        header.setName(look);
        header.setType(Imf::SCANLINEIMAGE);
        header.compression() = Imf::ZIP_COMPRESSION;
        header.zipCompressionLevel() = 2;  // of 9; four fifths of 4's time, for 1 % more bytes
        for (const std::string& channel : image.channels()) {
            header.channels().insert(
                channel, Imf::Channel(half && !stays_float(channel) ? Imf::HALF : Imf::FLOAT));
        }
        for (const auto& [name, value] : attributes) set_attribute(header, name, value);
        headers.push_back(header);
    }
    Imf::MultiPartOutputFile file(path.c_str(), headers.data(), static_cast<int>(headers.size()));
    for (std::size_t look = 0; look < image.looks().size(); ++look) {
        Imf::FrameBuffer buffer;
        std::vector<std::vector<::half>> halves(image.channels().size());
        for (std::size_t c = 0; c < image.channels().size(); ++c) {
            const std::string& channel = image.channels()[c];
            const float* const plane = image.plane(look, c);
            if (!half || stays_float(channel)) {
                buffer.insert(channel, slice(Imf::FLOAT, plane, image.window()));
                continue;
            }
            halves[c].resize(image.window().pixels());
            std::transform(plane, plane + halves[c].size(), halves[c].begin(),
                           [](float value) { return ::half(std::min(value, greatest_half)); });
            buffer.insert(channel, slice(Imf::HALF, halves[c].data(), image.window()));
        }
        Imf::OutputPart part(file, static_cast<int>(look));
        part.setFrameBuffer(buffer);
        part.writePixels(image.window().height());
    }
}

}  // namespace

LayeredImage::LayeredImage(const Bucket& window, std::vector<std::string> looks,
                           std::vector<std::string> channels)
    : window_(window),
      looks_(std::move(looks)),
      channels_(std::move(channels)),
      data_(looks_.size() * channels_.size() * window.pixels()) {}

std::size_t LayeredImage::look_index(const std::string& name) const {
    const auto found = std::find(looks_.begin(), looks_.end(), name);
    if (found == looks_.end()) throw InputError("there is no look \"" + name + "\" in this image");
    return static_cast<std::size_t>(found - looks_.begin());
}

void write_exr(const std::string& path, const LayeredImage& image, int width, int height, bool half,
               const Header& header) {
    try {
        WholeFile file(path);
        write_parts(file.location(), image, width, height, half, header);
        file.keep();
    } catch (const std::exception& error) {
        throw std::runtime_error(path + ": cannot be written (" + error.what() + ")");
    }
}

namespace {

std::vector<std::string> all_printable(std::vector<std::string> texts) {
    for (std::string& text : texts) text = printable(text);
    return texts;
}

InputError unreadable(const std::string& path, const std::exception& error) {
    return InputError(path + ": cannot be read as an EXR image (" + printable(error.what()) + ")");
}

}  // namespace

ExrFile read_exr(const std::string& path) {
    try {
        Imf::MultiPartInputFile file(path.c_str());
        ExrFile result;
        const Imath::Box2i data = file.header(0).dataWindow(),
                           display = file.header(0).displayWindow();
        const Bucket window{data.min.x, data.min.y, data.max.x + 1, data.max.y + 1};
        result.width = display.max.x + 1 - display.min.x;
        result.height = display.max.y + 1 - display.min.y;

        std::vector<std::string> looks, channels;
        for (int p = 0; p < file.parts(); ++p) {
            const Imf::Header& header = file.header(p);
            looks.push_back(header.hasName() ? header.name() : "");
            std::vector<std::string> names;
            for (auto c = header.channels().begin(); c != header.channels().end(); ++c)
                names.emplace_back(c.name());
            if (p == 0) channels = names;
            if (names != channels || header.dataWindow() != data)
                throw InputError("its parts differ in channels or size");
        }
        // Deflate packs no tighter than this: a damaged header must not claim more memory. In
        // doubles, for its claim may be beyond all integers.
        constexpr double tightest = 1032.0;
        const double least = static_cast<double>(window.pixels() * sizeof(::half)) *
                             static_cast<double>(channels.size() * looks.size());
        if (least / tightest > static_cast<double>(std::filesystem::file_size(path)))
            throw InputError("it is too short for its size");
        // What the file calls its parts and channels, and says of itself, goes into messages.
        result.image = LayeredImage(window, all_printable(looks), all_printable(channels));
        for (int p = 0; p < file.parts(); ++p) {
            Imf::FrameBuffer buffer;
            for (std::size_t c = 0; c < channels.size(); ++c) {
                buffer.insert(
                    channels[c],
                    slice(Imf::FLOAT, result.image.plane(static_cast<std::size_t>(p), c), window));
            }
            Imf::InputPart part(file, p);
            part.setFrameBuffer(buffer);
            part.readPixels(data.min.y, data.max.y);
        }
        for (auto it = file.header(0).begin(); it != file.header(0).end(); ++it) {
            if (const auto* text = dynamic_cast<const Imf::StringAttribute*>(&it.attribute())) {
                result.text[printable(it.name())] = printable(text->value());
            }
        }
        return result;
    } catch (const std::exception& error) {
        throw unreadable(path, error);
    }
}

void check_channels(const std::string& path) {
    if (!Imf::isOpenExrFile(path.c_str())) return;
    try {
        const Imf::MultiPartInputFile file(path.c_str());
        for (int p = 0; p < file.parts(); ++p) {
            const Imf::ChannelList& channels = file.header(p).channels();
            for (auto c = channels.begin(); c != channels.end(); ++c) {
                if (c.channel().type < 0 || c.channel().type >= Imf::NUM_PIXELTYPES)
                    throw InputError("channel \"" + std::string(c.name()) +
                                     "\" is of no known kind");
            }
        }
    } catch (const std::exception& error) {
        throw unreadable(path, error);
    }
}

}  // namespace pileus
