// The render loop: the samples of a bucket's pixels, over all threads.
#pragma once

#include "method.h"
#include "partial.h"

#include <atomic>
#include <cstdint>

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
    bool orders;  // whether to keep each order's image; needs a bounded number of them
};

/// Renders a task with `threads` threads (0: all there are). Each pixel's samples depend on (seed,
/// frame, pixel, sample index) alone. Throws InputError for a task that does not fit the scene,
/// Cancelled.
Partial render(const Scene& scene, const Transport& transport, const RenderTask& task, int threads,
               Control& control);

/// Renders the task in rounds until the bucket does its share for a frame that may have the RMS
/// relative error `tolerance` and has the mean opacity `opacity`, or all of the task's samples are
/// taken. A bucket may err by as much of it as it has of the opacity: where there is only sky there
/// is no noise, and the rest may have more. Samples begin at 0; the partial says how many there
/// are, and they are those that `render` takes.
Partial render_until(const Scene& scene, const Transport& transport, const RenderTask& task,
                     double tolerance, double opacity, int threads, Control& control);

}  // namespace pileus
