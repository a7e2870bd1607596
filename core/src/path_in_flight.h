// Paths in flight. A path is a coroutine that reads like a loop from event to event; where it needs
// to know what lies along a ray, it lays the ray down with the tracker and sleeps. So the rays of
// many paths are tracked together.
#pragma once

#include <coroutine>
#include <utility>

namespace pileus {

class Path {
  public:
    struct promise_type {
        Path get_return_object() {
            return Path(std::coroutine_handle<promise_type>::from_promise(*this));
        }
        std::suspend_always initial_suspend() noexcept { return {}; }
        std::suspend_always final_suspend() noexcept { return {}; }
        void return_void() {}
        void unhandled_exception() { throw; }
    };

    /// One that has ended.
    Path() = default;
    Path(Path&& other) noexcept : handle_(std::exchange(other.handle_, {})) {}
    Path& operator=(Path&& other) noexcept {
        std::swap(handle_, other.handle_);
        return *this;
    }
    ~Path() {
        if (handle_) handle_.destroy();
    }

    /// Goes on until the next rays lie with the tracker. Returns false at the path's end.
    bool resume() {
        if (!handle_) return false;
        handle_.resume();
        if (!handle_.done()) return true;
        std::exchange(handle_, {}).destroy();
        return false;
    }

  private:
    explicit Path(std::coroutine_handle<promise_type> handle) : handle_(handle) {}
    std::coroutine_handle<promise_type> handle_{};
};

/// `co_await tracked` sleeps until the rays that were laid down have been tracked.
inline constexpr std::suspend_always tracked{};

}  // namespace pileus
