#include "vdb_reader.h"

#include "error.h"

namespace pileus {

using openvdb::io::GridDescriptor;

VdbReader::VdbReader(const std::string& path)
    : file_(path, std::ios::binary), metadata_(new openvdb::io::StreamMetadata) {
    if (!file_) throw InputError("cannot be opened; mend its permissions");
    file_.exceptions(std::ios::failbit | std::ios::badbit);
    readHeader(file_);
    openvdb::io::setStreamMetadataPtr(file_, metadata_, /*transfer=*/false);
    openvdb::io::setVersion(file_, libraryVersion(), fileVersion());
    openvdb::io::setDataCompression(file_, compression());
    openvdb::MetaMap().readMeta(file_);
    const int count = readGridCount(file_);
    for (int i = 0; i < count; ++i) {
        Entry& entry = entries_.emplace_back();
        entry.grid = entry.descriptor.read(file_);
        if (inputHasGridOffsets()) {
            entry.descriptor.seekToEnd(file_);
        } else {  // written as a stream: what lies behind a grid is found by reading it
            readGrid(entry.grid, entry.descriptor, file_);
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

openvdb::GridBase::Ptr VdbReader::read(const Entry& entry) {
    if (inputHasGridOffsets()) {
        entry.descriptor.seekToGrid(file_);
        readGrid(entry.grid, entry.descriptor, file_);
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
