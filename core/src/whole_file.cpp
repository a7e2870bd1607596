#include "whole_file.h"

#include <cerrno>
#include <cstring>
#include <fcntl.h>
#include <filesystem>
#include <stdexcept>
#include <unistd.h>

namespace pileus {

namespace {

std::runtime_error last_error() { return std::runtime_error(std::strerror(errno)); }

void sync_folder(const std::string& path) {
    const int file = ::open(path.c_str(), O_RDONLY | O_CLOEXEC);
    const bool synced = file >= 0 && ::fsync(file) == 0;
    const auto reason = last_error();
    if (file >= 0) ::close(file);
    if (!synced) throw reason;
}

}  // namespace

WholeFile::WholeFile(const std::string& path)
    : path_(path), temporary_(path + "." + std::to_string(::getpid()) + ".tmp") {
    // It was not there before: no link that somebody laid in its place is followed.
    constexpr int flags = O_RDWR | O_CREAT | O_EXCL | O_NOFOLLOW | O_CLOEXEC;
    file_ = ::open(temporary_.c_str(), flags, 0666);
    if (file_ < 0 && errno == EEXIST) {  // left by an earlier process of our number
        ::unlink(temporary_.c_str());
        file_ = ::open(temporary_.c_str(), flags, 0666);
    }
    if (file_ < 0) throw last_error();
}

WholeFile::~WholeFile() {
    ::close(file_);
    if (!kept_) ::unlink(temporary_.c_str());
}

std::string WholeFile::location() const { return "/proc/self/fd/" + std::to_string(file_); }

void WholeFile::keep() {
    if (::fsync(file_) != 0 || ::rename(temporary_.c_str(), path_.c_str()) != 0) throw last_error();
    kept_ = true;
    sync_folder(std::filesystem::absolute(path_).parent_path().string());
}

}  // namespace pileus
