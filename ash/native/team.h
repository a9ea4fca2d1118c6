// Threads for one call. There is no pool: nothing idles, spins or survives a fork, and torch's own threads are left in peace.
// Starting and joining a thread costs about 20 microseconds (benchmarks: native/README.md).
#pragma once
#include <atomic>
#include <chrono>
#include <cstdint>
#include <system_error>
#include <thread>
#include <vector>

namespace ash {

// work(part) for every part in [0, parts), on up to `threads` threads, the caller's among them. Parts are handed out in order, so the
// long ones should come first. Which thread does which part must not matter to the result. `work` must not throw.
template <class Work> void in_parallel(int threads, int64_t parts, const Work& work) {
    std::atomic<int64_t> next{0};
    auto run = [&] {
        for (int64_t part; (part = next.fetch_add(1, std::memory_order_relaxed)) < parts;) work(part);
    };
    std::vector<std::thread> others;
    try {
        for (int i = 1; i < threads && i < parts; ++i) others.emplace_back(run);
    } catch (const std::system_error&) {
        // The machine gives no more threads: those there are do all the work.
    }
    run();
    for (auto& other : others) other.join();
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
