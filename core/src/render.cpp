// Renders tasks: each thread keeps many paths in flight, takes tile after tile, and sums samples in
// their order.
#include "render.h"

#include "camera_rays.h"
#include "error.h"
#include "pixel_sums.h"
#include "tiles.h"

#include <tbb/parallel_for.h>
#include <tbb/task_arena.h>

#include <algorithm>
#include <deque>
#include <numeric>

namespace pileus {

namespace {

/// A sample that is to be traced.
struct Sample {
    std::size_t pixel;
    bool last;  // of its pixel
    CameraRay ray;
    PathRandom random;
};

/// Samples in the order in which they are summed, and what their paths find.
struct Batch {
    std::size_t task = 0;
    std::vector<Sample> samples;
    std::vector<PathRecord> records;  // no fewer than samples
    std::size_t started = 0, ended = 0;
};

/// What all threads share.
struct Work {
    const Scene& scene;
    const Transport& transport;
    std::span<const RenderTask> tasks;
    std::span<Partial> partials;
    Control& control;
    const CameraRays rays;
    Tiles tiles;

    bool keep_orders() const { return tasks.front().orders > 0; }
    std::size_t layers() const {
        return static_cast<std::size_t>(std::max(tasks.front().orders, 1));
    }
};

/// The paths of one thread. As some end others start, from tile to tile, so that the tracker's
/// lanes stay full until no tile is left.
class Stream {
  public:
    explicit Stream(Work& work)
        : work_(work),
          method_(make_method(work.scene, work.transport)),
          tracker_(work.scene.volume->tree(), work.scene.medium.boxes()),
          kits_(std::clamp<std::size_t>(
                    (std::size_t{1} << 16) / (work.transport.looks.size() *
                                              static_cast<std::size_t>(method_->orders_at_once())),
                    1, in_flight),
                PathKit(tracker_, work.scene.lights.size())),
          paths_(kits_.size()),
          batch_of_(kits_.size()),
          idle_(kits_.size()),
          blank_(work.transport.looks.size(), work.layers()),
          most_(std::clamp<std::size_t>((std::size_t{1} << 20) / (work.transport.looks.size() *
                                                                  work.layers() * sizeof(Color)),
                                        2, 1024)),
          sums_(work.transport.looks.size(), work.layers(), work.keep_orders()) {
        std::iota(idle_.begin(), idle_.end(), std::size_t{0});
    }

    void run() {
        start();
        while (!flying_.empty()) {
            end_if_cancelled();
            tracker_.run();
            go_on();
            // Many at once, so that camera rays, too, fill the lanes.
            if (4 * idle_.size() >= paths_.size()) start();
        }
        settle();
    }

  private:
    // Enough paths that the lanes stay full, and few enough to lie in a cache. Fewer where an event
    // may ask for very many looks and orders at once.
    static constexpr std::size_t in_flight = 256;
    // A batch waits for its longest path, and no more than so many batches wait.
    static constexpr std::size_t most_batches = 8;

    void end_if_cancelled() const {
        if (work_.control.cancelled.load(std::memory_order_relaxed)) throw Cancelled();
    }

    void start() {
        while (!idle_.empty()) {
            if ((batches_.empty() || batches_.back().started == batches_.back().samples.size()) &&
                !gather())
                return;
            Batch& batch = batches_.back();
            const Sample& sample = batch.samples[batch.started];
            PathRecord& record = batch.records[batch.started++];
            record.clear();
            if (sample.ray.volume) {
                const std::size_t slot = idle_.back();
                paths_[slot] = method_->trace(sample.ray, sample.random, record, kits_[slot]);
                if (paths_[slot].resume()) {
                    batch_of_[slot] = &batch;
                    idle_.pop_back();
                    flying_.push_back(slot);
                    continue;
                }
            }
            ++batch.ended;
        }
    }

    void go_on() {
        auto kept = flying_.begin();
        for (const std::size_t slot : flying_) {
            if (paths_[slot].resume()) {
                *kept++ = slot;
            } else {
                ++batch_of_[slot]->ended;
                idle_.push_back(slot);
            }
        }
        flying_.erase(kept, flying_.end());
    }

    /// Begins another batch of the tile, or of the next one.
    bool gather() {
        end_if_cancelled();
        settle();
        if (batches_.size() == most_batches) return false;
        if (!tile_) {
            tile_ = work_.tiles.take();
            if (!tile_) return false;
            x_ = tile_->area.x0;
            y_ = tile_->area.y0;
            sample_ = work_.tasks[tile_->task].samples.first;
        }
        Batch batch;
        if (!spare_.empty()) {
            batch = std::move(spare_.back());
            spare_.pop_back();
        }
        batch.task = tile_->task;
        fill(batch);
        if (batch.records.size() < batch.samples.size())
            batch.records.resize(batch.samples.size(), blank_);
        batches_.push_back(std::move(batch));
        return true;
    }

    /// The next samples of the tile.
    void fill(Batch& batch) {
        const RenderTask& task = work_.tasks[batch.task];
        const Bucket& bucket = task.bucket;
        const std::uint64_t frame_key =
            hash_key(hash_key(0, task.seed), static_cast<std::uint64_t>(task.frame));
        for (; y_ < tile_->area.y1; ++y_, x_ = tile_->area.x0) {
            const std::uint64_t row_key = hash_key(frame_key, static_cast<std::uint64_t>(y_));
            for (; x_ < tile_->area.x1; ++x_, sample_ = task.samples.first) {
                const std::uint64_t pixel_key = hash_key(row_key, static_cast<std::uint64_t>(x_));
                const auto pixel = static_cast<std::size_t>(y_ - bucket.y0) *
                                       static_cast<std::size_t>(bucket.width()) +
                                   static_cast<std::size_t>(x_ - bucket.x0);
                for (; sample_ < task.samples.last; ++sample_) {
                    if (batch.samples.size() == most_) return;
                    const PathRandom random(pixel_key, static_cast<std::uint32_t>(sample_));
                    batch.samples.push_back({pixel, sample_ + 1 == task.samples.last,
                                             work_.rays.through(x_ + double{random.first[0]},
                                                                y_ + double{random.first[1]}),
                                             random});
                }
            }
        }
        tile_.reset();
    }

    /// Sums the batches that have ended, the earlier ones first.
    void settle() {
        while (!batches_.empty() && batches_.front().ended == batches_.front().samples.size()) {
            Batch batch = std::move(batches_.front());
            batches_.pop_front();
            Partial& partial = work_.partials[batch.task];
            const int count = work_.tasks[batch.task].samples.count();
            for (std::size_t i = 0; i < batch.samples.size(); ++i) {
                const Sample& sample = batch.samples[i];
                PathRecord& record = batch.records[i];
                if (work_.scene.background && record.opacity < 1.0f) {
                    record.sky = work_.scene.sky(sample.ray.direction) * (1.0f - record.opacity);
                }
                if (record.bounded) std::atomic_ref(partial.bounded_paths).fetch_add(1);
                sums_.add(record);
                if (!sample.last) continue;
                sums_.store(partial.image, sample.pixel, count);
                sums_.clear();
                work_.control.samples_done.fetch_add(count, std::memory_order_relaxed);
            }
            batch.samples.clear();
            batch.started = batch.ended = 0;
            spare_.push_back(std::move(batch));
        }
    }

    Work& work_;
    std::unique_ptr<Method> method_;
    Tracker tracker_;
    std::vector<PathKit> kits_;  // one for each path in flight
    std::vector<Path> paths_;
    std::vector<Batch*> batch_of_;  // of a path that flies
    std::vector<std::size_t> idle_, flying_;
    std::deque<Batch> batches_;  // stay where they are as others come and go
    std::vector<Batch> spare_;
    PathRecord blank_;
    std::size_t most_;  // samples of a batch, so that its records take at most a MiB
    PixelSums sums_;
    // The tile that is being gathered, and where.
    std::optional<Tile> tile_;
    int x_ = 0, y_ = 0, sample_ = 0;
};

void check(const Scene& scene, const RenderTask& task, int orders) {
    const Bucket& b = task.bucket;
    if (b.x0 < 0 || b.y0 < 0 || b.x1 > scene.width || b.y1 > scene.height || b.width() < 1 ||
        b.height() < 1) {
        throw InputError("the bucket is empty or lies outside the image");
    }
    if (task.samples.first < 0 || task.samples.count() < 1)
        throw InputError("the sample range is empty");
    if (task.orders != orders || orders < 0)
        throw InputError("all tasks keep equally many orders, at least 0");
}

}  // namespace

std::vector<Partial> render(const Scene& scene, const Transport& transport,
                            std::span<const RenderTask> tasks, int threads, Control& control) {
    if (tasks.empty()) return {};
    std::vector<std::string> looks;
    for (const Look& look : transport.looks) looks.push_back(look.name);
    std::vector<Partial> partials;
    for (const RenderTask& task : tasks) {
        check(scene, task, tasks.front().orders);
        Partial& partial = partials.emplace_back();
        partial.width = scene.width;
        partial.height = scene.height;
        partial.samples = task.samples;
        partial.image =
            LayeredImage(task.bucket, looks, channel_names(static_cast<std::size_t>(task.orders)));
    }
    Work work{scene, transport, tasks, partials, control, CameraRays(scene), Tiles(tasks)};
    tbb::task_arena arena(threads > 0 ? threads : tbb::task_arena::automatic);
    arena.execute([&] {
        const auto streams =
            std::min(static_cast<std::size_t>(arena.max_concurrency()), work.tiles.count());
        tbb::parallel_for(
            std::size_t{0}, streams, [&](std::size_t) { Stream(work).run(); },
            tbb::simple_partitioner());
    });
    return partials;
}

}  // namespace pileus
