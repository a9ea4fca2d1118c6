// Threads for one call: those of torch's own OpenMP runtime, where ash/native/library.py found it. Its idle threads spin
// after each of torch's operations and would share the cores with a second team: splatting on threads of its own, in turn with
// convolutions, took 1.8 times as long. Without that runtime a call starts and joins its threads, about 20 microseconds each.
#pragma once
#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdint>
#include <system_error>
#include <thread>
#include <vector>

namespace ash {

// OpenMP's GOMP_parallel: calls a function with its data on that many threads of the runtime, the caller's among them.
using Parallel = void (*)(void (*)(void*), void*, unsigned threads, unsigned flags);
inline std::atomic<Parallel> parallel_of_torch{nullptr};

// work(part) for every part in [0, parts), on up to `threads` threads, the caller's among them. Parts are handed out in order, so the
// long ones should come first. Which thread does which part must not matter to the result. `work` must not throw.
template <class Work> void in_parallel(int threads, int64_t parts, const Work& work) {
    std::atomic<int64_t> next{0};
    auto run = [&] {
        for (int64_t part; (part = next.fetch_add(1, std::memory_order_relaxed)) < parts;) work(part);
    };
    const int64_t wanted = threads < parts ? threads : parts;
    if (wanted <= 1) return run();
    if (Parallel parallel = parallel_of_torch.load(std::memory_order_relaxed))
        return parallel([](void* given) { (*static_cast<decltype(run)*>(given))(); }, &run, unsigned(wanted), 0);
    std::vector<std::thread> others;
    try {
        for (int64_t i = 1; i < wanted; ++i) others.emplace_back(run);
    } catch (const std::system_error&) {
        // The machine gives no more threads: those there are do all the work.
    }
    run();
    for (auto& other : others) other.join();
}

// work(part, first, last) for [0, count) in ranges of `size`: fixed, so that sums per range do not depend on the threads.
template <class Work> void in_ranges(int threads, int64_t count, int64_t size, const Work& work) {
    in_parallel(threads, (count + size - 1) / size, [&](int64_t part) { work(part, part * size, std::min(count, (part + 1) * size)); });
}

// Seconds that the stages of the last calls took, for benchmarks. Calls at the same time mix their numbers.
enum Stage { STAGE_PROJECT, STAGE_LIST, STAGE_BLEND, STAGE_BLEND_BACKWARD, STAGE_GATHER, STAGE_PROJECT_BACKWARD, STAGES };
inline std::atomic<double> stage_seconds[STAGES];

struct Stopwatch {
    Stage stage;
    std::chrono::steady_clock::time_point start = std::chrono::steady_clock::now();
    explicit Stopwatch(Stage s) : stage(s) {}
    ~Stopwatch() { stage_seconds[stage] = std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count(); }
};

}  // namespace ash
