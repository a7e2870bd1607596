#include "render.h"

#include "camera_rays.h"
#include "error.h"

#include <tbb/blocked_range2d.h>
#include <tbb/enumerable_thread_specific.h>
#include <tbb/parallel_for.h>
#include <tbb/task_arena.h>

#include <algorithm>
#include <cmath>
#include <numeric>

namespace pileus {

namespace {

/// Sums over one pixel's samples.
class PixelSums {
  public:
    PixelSums(std::size_t looks, std::size_t orders, bool keep_orders)
        : keep_orders_(keep_orders),
          sum_(looks, V3d(0.0)),
          squares_(looks, V3d(0.0)),
          order_sums_(keep_orders ? looks * orders : 0, V3d(0.0)) {}

    void clear() {
        std::fill(sum_.begin(), sum_.end(), V3d(0.0));
        std::fill(squares_.begin(), squares_.end(), V3d(0.0));
        std::fill(order_sums_.begin(), order_sums_.end(), V3d(0.0));
        opacity_ = depth_ = 0.0;
    }

    void add(const PathRecord& record) {
        for (std::size_t look = 0; look < sum_.size(); ++look) {
            V3d radiance(record.sky);
            for (std::size_t i = 0; i < record.orders(); ++i) {
                const V3d layer(record.radiance(look, i));
                radiance += layer;
                if (keep_orders_) order_sums_[look * record.orders() + i] += layer;
            }
            sum_[look] += radiance;
            squares_[look] += radiance * radiance;
        }
        opacity_ += record.opacity;
        depth_ += record.opacity * record.depth;
    }

    void store(LayeredImage& image, std::size_t pixel, int count) const {
        const double n = count;
        for (std::size_t look = 0; look < sum_.size(); ++look) {
            const auto set = [&](std::size_t channel, double value) {
                image.plane(look, channel)[pixel] = storable(value);
            };
            for (int c = 0; c < 3; ++c) {
                const auto channel = static_cast<std::size_t>(c);
                const double mean = sum_[look][c] / n;
                set(Partial::r + channel, mean);
                const double spread = std::max(0.0, squares_[look][c] - mean * sum_[look][c]);
                set(Partial::variance_r + channel, count > 1 ? spread / (n * (n - 1.0)) : 0.0);
            }
            set(Partial::a, opacity_ / n);
            set(Partial::z, opacity_ > 0.0 ? depth_ / opacity_ : 0.0);
            const std::size_t orders = order_sums_.size() / sum_.size();
            for (std::size_t i = 0; i < orders; ++i) {
                for (int c = 0; c < 3; ++c) {
                    set(Partial::first_order + 3 * i + static_cast<std::size_t>(c),
                        order_sums_[look * orders + i][c] / n);
                }
            }
        }
    }

  private:
    bool keep_orders_;
    std::vector<V3d> sum_, squares_, order_sums_;
    double opacity_ = 0.0, depth_ = 0.0;
};

/// A sample that is to be traced.
struct Sample {
    std::size_t pixel;
    bool last;  // of its pixel
    CameraRay ray;
    PathRandom random;
};

/// What one thread traces with.
struct Workspace {
    // Enough paths in flight that the tracker's lanes stay full, and few enough to lie in a cache.
    // Fewer where an event may ask for very many looks and orders at once.
    static constexpr std::size_t in_flight = 256;
    // So many samples are traced before they are summed in their order: the more, the longer the
    // lanes stay full.
    static constexpr std::size_t gathered = 8192;

    Workspace(const Scene& scene, const Transport& transport, std::size_t orders, bool keep_orders)
        : method(make_method(scene, transport)),
          tracker(std::make_unique<Tracker>(scene.volume->tree(), scene.medium.boxes())),
          kits(std::clamp<std::size_t>(
                   (std::size_t{1} << 16) /
                       (transport.looks.size() *
                        static_cast<std::size_t>(transport.max_bounces.value_or(1))),
                   1, in_flight),
               PathKit(*tracker, scene.lights.size())),
          blank(transport.looks.size(), orders),
          sums(transport.looks.size(), orders, keep_orders),
          most(std::clamp<std::size_t>(
              (std::size_t{8} << 20) / (transport.looks.size() * orders * sizeof(Color)), 16,
              gathered)) {}

    std::unique_ptr<Method> method;
    std::unique_ptr<Tracker> tracker;
    std::vector<PathKit> kits;  // one for each path in flight
    std::vector<Sample> samples;
    std::vector<PathRecord> records;  // as many as there were samples
    PathRecord blank;
    PixelSums sums;
    std::size_t most;  // samples, so that their records take a few MiB
};

/// Traces the samples into their records.
void trace(Workspace& work, const Scene& scene, const Control& control) {
    if (work.records.size() < work.samples.size())
        work.records.resize(work.samples.size(), work.blank);
    std::vector<Path> paths(work.kits.size());
    std::vector<std::size_t> idle(paths.size()), flying;
    std::iota(idle.begin(), idle.end(), std::size_t{0});
    std::size_t next = 0;
    const auto start = [&] {
        while (!idle.empty() && next < work.samples.size()) {
            const Sample& sample = work.samples[next];
            PathRecord& record = work.records[next++];
            record.clear();
            if (!sample.ray.volume) continue;
            const std::size_t slot = idle.back();
            paths[slot] = work.method->trace(sample.ray, sample.random, record, work.kits[slot]);
            if (!paths[slot].resume()) continue;
            idle.pop_back();
            flying.push_back(slot);
        }
    };
    do {
        if (control.cancelled.load(std::memory_order_relaxed)) throw Cancelled();
        // Many at once, so that camera rays, too, fill the lanes.
        if (4 * idle.size() >= paths.size()) start();
        work.tracker->run();
        auto kept = flying.begin();
        for (const std::size_t slot : flying) {
            if (paths[slot].resume()) {
                *kept++ = slot;
            } else {
                idle.push_back(slot);
            }
        }
        flying.erase(kept, flying.end());
    } while (!flying.empty() || next < work.samples.size());
    if (!scene.background) return;
    for (std::size_t i = 0; i < work.samples.size(); ++i) {
        PathRecord& record = work.records[i];
        if (record.opacity < 1.0f)
            record.sky = scene.sky(work.samples[i].ray.direction) * (1.0f - record.opacity);
    }
}

void check(const Scene& scene, const Transport& transport, const RenderTask& task) {
    const Bucket& b = task.bucket;
    if (b.x0 < 0 || b.y0 < 0 || b.x1 > scene.width || b.y1 > scene.height || b.width() < 1 ||
        b.height() < 1) {
        throw InputError("the bucket is empty or lies outside the image");
    }
    if (task.samples.first < 0 || task.samples.count() < 1)
        throw InputError("the sample range is empty");
    if (task.orders && !transport.max_bounces) {
        throw InputError(
            "image.orders needs a bounded number of orders; set transport.max_bounces");
    }
}

}  // namespace

Partial render(const Scene& scene, const Transport& transport, const RenderTask& task, int threads,
               Control& control) {
    check(scene, transport, task);
    const std::size_t orders = task.orders ? static_cast<std::size_t>(*transport.max_bounces) : 1;
    std::vector<std::string> looks;
    for (const Look& look : transport.looks) looks.push_back(look.name);

    Partial partial;
    partial.width = scene.width;
    partial.height = scene.height;
    partial.samples = task.samples;
    partial.image = LayeredImage(task.bucket, looks, channel_names(task.orders ? orders : 0));

    const CameraRays rays(scene);
    const std::uint64_t frame_key =
        hash_key(hash_key(0, task.seed), static_cast<std::uint64_t>(task.frame));
    std::atomic<std::int64_t> bounded{0};
    tbb::enumerable_thread_specific<Workspace> workspaces(
        [&] { return Workspace(scene, transport, orders, task.orders); });

    // Traces what a thread has gathered.
    const auto settle = [&](Workspace& work) {
        trace(work, scene, control);
        for (std::size_t i = 0; i < work.samples.size(); ++i) {
            const Sample& sample = work.samples[i];
            if (work.records[i].bounded) bounded.fetch_add(1, std::memory_order_relaxed);
            work.sums.add(work.records[i]);
            if (!sample.last) continue;
            work.sums.store(partial.image, sample.pixel, task.samples.count());
            work.sums.clear();
            control.samples_done.fetch_add(task.samples.count(), std::memory_order_relaxed);
        }
        work.samples.clear();
    };

    const auto gather_pixel = [&](Workspace& work, int x, int y) {
        const std::uint64_t pixel_key = hash_key(hash_key(frame_key, static_cast<std::uint64_t>(y)),
                                                 static_cast<std::uint64_t>(x));
        const auto pixel = static_cast<std::size_t>(y - task.bucket.y0) *
                               static_cast<std::size_t>(task.bucket.width()) +
                           static_cast<std::size_t>(x - task.bucket.x0);
        for (int sample = task.samples.first; sample < task.samples.last; ++sample) {
            const PathRandom random(pixel_key, static_cast<std::uint32_t>(sample));
            work.samples.push_back(
                {pixel, sample + 1 == task.samples.last,
                 rays.through(x + double{random.first[0]}, y + double{random.first[1]}), random});
            if (work.samples.size() == work.most) settle(work);
        }
    };

    // Tiles of enough samples to be traced together.
    const int side = std::clamp(
        static_cast<int>(std::sqrt(double{Workspace::gathered} / task.samples.count())), 4, 32);
    using Tiles = tbb::blocked_range2d<int>;
    tbb::task_arena arena(threads > 0 ? threads : tbb::task_arena::automatic);
    arena.execute([&] {
        const Tiles tiles(task.bucket.y0, task.bucket.y1, static_cast<std::size_t>(side),
                          task.bucket.x0, task.bucket.x1, static_cast<std::size_t>(side));
        tbb::parallel_for(tiles, [&](const Tiles& tile) {
            Workspace& work = workspaces.local();
            for (int y = tile.rows().begin(); y != tile.rows().end(); ++y) {
                for (int x = tile.cols().begin(); x != tile.cols().end(); ++x)
                    gather_pixel(work, x, y);
            }
            settle(work);
        });
    });
    partial.bounded_paths = bounded;
    return partial;
}

Partial render_until(const Scene& scene, const Transport& transport, const RenderTask& task,
                     double tolerance, double opacity, int threads, Control& control) {
    // What is shared out evenly, for noise that has nothing to do with opacity, as of a sky's
    // texture at the pixels' edges; where there is none, the frame's error is so much smaller.
    constexpr double even = 0.1;
    if (!(tolerance > 0.0)) throw InputError("the tolerance must be positive");
    if (!(opacity > 0.0)) throw InputError("the frame's opacity must be positive");
    RenderTask round = task;
    round.samples = {0, 1};
    Partial partial = render(scene, transport, round, threads, control);
    while (partial.samples.last < task.samples.last) {
        const int taken = partial.samples.last;
        const double share = even + (1.0 - even) * partial.opacity() / opacity;
        const double error = partial.relative_error() / tolerance;
        // Few samples have met few of the rare bright paths and make too little of them: n count
        // as n / (1 + 1 / n).
        const double needed = error * error / share * taken;
        const double wanted = std::ceil((needed + std::sqrt(needed * (needed + 4.0))) / 2.0);
        if (!(wanted > taken)) break;
        // From a round that is too short to know, not too far.
        const double next = std::min({wanted, 4.0 * taken, double(task.samples.last)});
        round.samples = {taken, static_cast<int>(next)};
        partial.pool(render(scene, transport, round, threads, control));
    }
    return partial;
}

}  // namespace pileus
