// The render loop: the samples of a bucket's pixels, over all threads.
#pragma once

#include "method.h"
#include "partial.h"

#include <atomic>
#include <cstdint>
#include <span>
#include <vector>

namespace pileus {

/// What a caller in another thread sees of a render, and how it ends it.
struct Control {
    std::atomic<std::int64_t> samples_done{0};  // pixel samples
    std::atomic<bool> cancelled{false};
};

/// Thrown by a render that was cancelled.
struct Cancelled : std::runtime_error {
    Cancelled() : std::runtime_error("cancelled") {}
};

struct RenderTask {
    Bucket bucket;
    SampleRange samples;
    std::uint64_t seed;
    int frame;
    int orders;  // how many orders' images to keep; the last one holds all later orders, too
};

/// Renders tasks of one frame with `threads` threads (0: all there are); they keep equally many
/// orders. Each pixel's samples depend on (seed, frame, pixel, sample index) alone. Throws
/// InputError for a task that does not fit the scene, Cancelled.
std::vector<Partial> render(const Scene& scene, const Transport& transport,
                            std::span<const RenderTask> tasks, int threads, Control& control);

inline Partial render(const Scene& scene, const Transport& transport, const RenderTask& task,
                      int threads, Control& control) {
    return std::move(render(scene, transport, {&task, 1}, threads, control).front());
}

}  // namespace pileus
