#include "vdb_reader.h"

#include "error.h"

#include <openvdb/io/DelayedLoadMetadata.h>

#include <cstdint>

namespace pileus {

using openvdb::io::GridDescriptor;

namespace {

// Looks ahead over texts and values that OpenVDB is about to read, each led by its length, and
// throws as at the file's end where one is longer than what is left: OpenVDB would first fill as
// much memory, up to 4 GB.
class LengthCheck {
  public:
    explicit LengthCheck(std::istream& file) : file_(file), begin_(file.tellg()) {
        file_.seekg(0, std::ios::end);
        end_ = file_.tellg();
        file_.seekg(begin_);
    }

    void lengths(std::int64_t count) {
        for (; count > 0; --count) skip(number());
    }

    // A count, and for each a name, a type and a value.
    void metadata() { lengths(std::int64_t{3} * number()); }

    void skip(std::uint32_t bytes) {
        if (bytes > end_ - file_.tellg()) file_.setstate(std::ios::failbit);
        file_.seekg(bytes, std::ios::cur);
    }

    void back() { file_.seekg(begin_); }

  private:
    std::uint32_t number() {
        std::uint32_t value = 0;
        file_.read(reinterpret_cast<char*>(&value), sizeof value);
        return value;
    }

    std::istream& file_;
    std::streampos begin_, end_;
};

}  // namespace

WholeReads::WholeReads(const std::string& path) {
    if (open(path, std::ios::in | std::ios::binary) == nullptr) return;
    size_ = pubseekoff(0, std::ios::end, std::ios::in);
    pubseekoff(0, std::ios::beg, std::ios::in);
}

std::streamsize WholeReads::xsgetn(char* to, std::streamsize count) {
    if (count > egptr() - gptr() && count > size_ - pubseekoff(0, std::ios::cur, std::ios::in))
        return 0;
    return std::filebuf::xsgetn(to, count);
}

VdbReader::VdbReader(const std::string& path)
    : buffer_(path), file_(&buffer_), metadata_(new openvdb::io::StreamMetadata) {
    if (!buffer_.is_open()) throw InputError("cannot be opened; mend its permissions");
    file_.exceptions(std::ios::failbit | std::ios::badbit);
    // Its counts are taken on trust, and serve delayed loading alone.
    openvdb::io::DelayedLoadMetadata::unregisterType();
    readHeader(file_);
    openvdb::io::setStreamMetadataPtr(file_, metadata_, /*transfer=*/false);
    openvdb::io::setVersion(file_, libraryVersion(), fileVersion());
    openvdb::io::setDataCompression(file_, compression());
    LengthCheck ahead(file_);
    ahead.metadata();
    ahead.back();
    openvdb::MetaMap().readMeta(file_);
    const int count = readGridCount(file_);
    for (int i = 0; i < count; ++i) {
        Entry& entry = entries_.emplace_back();
        LengthCheck head(file_);
        head.lengths(3);  // its name, its type and its parent's name
        head.back();
        entry.grid = entry.descriptor.read(file_);
        if (inputHasGridOffsets()) {
            entry.descriptor.seekToEnd(file_);
        } else {  // written as a stream: what lies behind a grid is found by reading it
            read_voxels(entry);
        }
    }
}

std::string VdbReader::listing() const {
    std::string text;
    for (const Entry& entry : entries_) {
        text += (text.empty() ? "" : ", ") +
                ('"' + GridDescriptor::nameAsString(entry.descriptor.uniqueName())) + "\" (" +
                entry.grid->valueType() + ")";
    }
    return text.empty() ? "no grid at all" : text;
}

const VdbReader::Entry* VdbReader::find(const std::string& name) const {
    for (const Entry& entry : entries_) {
        const std::string unique = GridDescriptor::nameAsString(entry.descriptor.uniqueName());
        if (unique == name || unique == name + "[0]") return &entry;
    }
    return nullptr;
}

void VdbReader::read_voxels(const Entry& entry) {
    LengthCheck ahead(file_);
    if (fileVersion() >= openvdb::OPENVDB_FILE_VERSION_SELECTIVE_COMPRESSION)
        ahead.skip(sizeof(std::uint32_t));
    ahead.metadata();
    if (fileVersion() >= openvdb::OPENVDB_FILE_VERSION_NEW_TRANSFORM)
        ahead.lengths(1);  // the kind of its transform
    ahead.back();
    readGrid(entry.grid, entry.descriptor, file_);
}

openvdb::GridBase::Ptr VdbReader::read(const Entry& entry) {
    if (inputHasGridOffsets()) {
        entry.descriptor.seekToGrid(file_);
        read_voxels(entry);
    }
    // An instance has a name and a transform of its own, and the voxels of another grid.
    if (entry.descriptor.isInstance()) {
        const std::string& parent = entry.descriptor.instanceParentName();
        for (const Entry& other : entries_) {
            if (other.descriptor.uniqueName() != parent || other.descriptor.isInstance()) continue;
            entry.grid->setTree(read(other)->baseTreePtr());
            return entry.grid;
        }
        throw InputError("has a grid that is an instance of one that it lacks");
    }
    return entry.grid;
}

}  // namespace pileus
