// Reads single grids of OpenVDB files, as openvdb::io::File does, but through a stream that throws
// at the file's end: OpenVDB does not look, and a damaged count has it read nothing for hours.
#pragma once

#include <openvdb/io/Archive.h>
#include <openvdb/io/GridDescriptor.h>
#include <openvdb/io/io.h>

#include <fstream>
#include <istream>
#include <string>
#include <vector>

namespace pileus {

/// A file that gives each read whole or refuses it, with nothing put down: OpenVDB reads as many
/// bytes as a file says into room for fewer, and looks afterwards whether that was right.
class WholeReads : public std::filebuf {
  public:
    explicit WholeReads(const std::string& path);

  protected:
    std::streamsize xsgetn(char* to, std::streamsize count) override;

  private:
    std::streamoff size_ = 0;
};

/// An open file. Throws what OpenVDB throws, and std::ios_base::failure where the file ends amid
/// what it promised.
class VdbReader : private openvdb::io::Archive {
  public:
    explicit VdbReader(const std::string& path);

    /// What the file holds, for messages: "density" (float), "v" (vec3s).
    std::string listing() const;

    /// A grid by name, "name[n]" for the n-th (from 0) of several with one name; null for none.
    /// `wanted` is asked before its voxels are read, with an empty grid of its type.
    template <class Wanted>
    openvdb::GridBase::Ptr read(const std::string& name, Wanted wanted) {
        const Entry* const entry = find(name);
        if (entry == nullptr) return nullptr;
        wanted(*entry->grid);
        return read(*entry);
    }

  private:
    struct Entry {
        openvdb::io::GridDescriptor descriptor;
        openvdb::GridBase::Ptr grid;  // empty, of the right type, where the file can be sought in
    };

    const Entry* find(const std::string& name) const;
    openvdb::GridBase::Ptr read(const Entry& entry);
    void read_voxels(const Entry& entry);

    WholeReads buffer_;
    std::istream file_;
    openvdb::SharedPtr<openvdb::io::StreamMetadata> metadata_;
    std::vector<Entry> entries_;
};

}  // namespace pileus
