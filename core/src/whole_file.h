// Files that come to be whole or not at all: written under a temporary name beside their own,
// synced and renamed.
#pragma once

#include <string>

namespace pileus {

/// A new file, which takes the place of `path` once it is kept, and else is gone with this object.
class WholeFile {
  public:
    /// Throws std::runtime_error, which says why it cannot be made.
    explicit WholeFile(const std::string& path);
    WholeFile(const WholeFile&) = delete;
    WholeFile& operator=(const WholeFile&) = delete;
    ~WholeFile();

    /// Leads to this very file, for those who open by name.
    std::string location() const;

    /// Puts it in its place, for good. Throws std::runtime_error, which says why it cannot.
    void keep();

  private:
    std::string path_, temporary_;
    int file_;
    bool kept_ = false;
};

}  // namespace pileus
