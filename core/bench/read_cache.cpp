// What it costs to read a cache: the sampling structure against OpenVDB's own reading of the same
// grid, at three sizes. Each reading is a process of its own, in turn, so that times and peaks are
// its own; prints medians and their ratios.
//   bench_read_cache [FOLDER]     (the caches are written there once, 0.5 GB; default: the
//   temporary folder)
#include "random.h"
#include "volume.h"

#include <openvdb/io/File.h>
#include <openvdb/openvdb.h>
#include <tbb/parallel_for.h>

#include <algorithm>
#include <chrono>
#include <cstdio>
#include <filesystem>
#include <functional>
#include <string>
#include <sys/resource.h>
#include <sys/wait.h>
#include <unistd.h>
#include <vector>

namespace {

using Leaf = openvdb::FloatTree::LeafNodeType;

/// A cube of voxels with values that do not compress to nothing.
void write_cache(const std::string& path, int width) {
    const auto grid = openvdb::FloatGrid::create();
    const int leaves = width / 8;
    std::vector<Leaf*> made(static_cast<std::size_t>(leaves) * leaves * leaves);
    tbb::parallel_for(std::size_t{0}, made.size(), [&](std::size_t i) {
        const int n = static_cast<int>(i);
        const openvdb::Coord origin(8 * (n / (leaves * leaves)), 8 * (n / leaves % leaves),
                                    8 * (n % leaves));
        pileus::Random random(i);
        made[i] = new Leaf(origin, 0.0f, true);  // the tree takes it over below
        for (openvdb::Index v = 0; v < Leaf::SIZE; ++v)
            made[i]->setValueOnly(v, 0.25f + random.uniform());
    });
    for (Leaf* const leaf : made) grid->tree().addLeaf(leaf);
    grid->setName("density");
    openvdb::io::File(path).write({grid});
}

struct Cost {
    double seconds;
    double peak_megabytes;
};

/// Runs `read` in a child and reports its seconds and its peak memory, the program's own included.
Cost measure(const std::function<void()>& read) {
    int channel[2];
    if (::pipe(channel) != 0) std::abort();
    const pid_t child = ::fork();
    if (child == 0) {
        const auto start = std::chrono::steady_clock::now();
        read();
        const double seconds =
            std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
        if (::write(channel[1], &seconds, sizeof seconds) != sizeof seconds) ::_exit(1);
        ::_exit(0);
    }
    Cost cost{};
    if (::read(channel[0], &cost.seconds, sizeof cost.seconds) != sizeof cost.seconds) std::abort();
    rusage usage{};
    int status = 0;
    ::wait4(child, &status, 0, &usage);
    cost.peak_megabytes = static_cast<double>(usage.ru_maxrss) / 1024.0;
    ::close(channel[0]);
    ::close(channel[1]);
    return cost;
}

double median(std::vector<double> values) {
    std::sort(values.begin(), values.end());
    return values[values.size() / 2];
}

}  // namespace

int main(int argc, char** argv) {
    openvdb::initialize();
    const std::filesystem::path folder =
        argc > 1 ? argv[1] : std::filesystem::temp_directory_path();
    std::printf("%12s %28s %28s\n", "", "seconds", "peak MB");
    std::printf("%12s %9s %9s %8s %9s %9s %8s\n", "voxels", "OpenVDB", "Pileus", "ratio", "OpenVDB",
                "Pileus", "ratio");
    for (const int width : {104, 216, 464}) {
        const std::string path =
            (folder / ("read_cache_" + std::to_string(width) + ".vdb")).string();
        if (!std::filesystem::exists(path)) {
            // In a child, so that this process stays as small as the peaks below assume.
            measure([&] { write_cache(path, width); });
        }
        const double base = measure([] {}).peak_megabytes;
        std::vector<double> seconds[2], peaks[2];
        for (int run = 0; run < 5; ++run) {
            const Cost theirs = measure([&] {
                openvdb::io::File file(path);
                file.open(false);
                file.readGrid("density");
            });
            const Cost ours = measure([&] { const pileus::Volume volume(path, "density"); });
            seconds[0].push_back(theirs.seconds);
            seconds[1].push_back(ours.seconds);
            peaks[0].push_back(theirs.peak_megabytes - base);
            peaks[1].push_back(ours.peak_megabytes - base);
        }
        std::printf("%12lld", static_cast<long long>(width) * width * width);
        for (const auto& pair : {seconds, peaks}) {
            const double a = median(pair[0]), b = median(pair[1]);
            std::printf(" %9.3f %9.3f %8.2f", a, b, b / a);
        }
        std::printf("\n");
    }
}
