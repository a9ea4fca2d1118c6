// The instruction set: the best that this machine runs, unless another is asked for by name.
#include "dispatch.h"

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstring>
#include <numeric>
#include <vector>

#include <pthread.h>

#include "team.h"

namespace ash {

static bool runs(const Kernels* kernels) {
#ifdef ASH_X86
    if (kernels == &avx512_kernels)
        return __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512bw") &&
               __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
    if (kernels == &avx2_kernels) return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
#endif
    return kernels == &plain_kernels;
}

static const Kernels* const all_kernels[] = {
#ifdef ASH_X86
    &avx512_kernels, &avx2_kernels,
#endif
    &plain_kernels};

static std::atomic<const Kernels*> chosen{nullptr};

const Kernels& kernels() {
    const Kernels* now = chosen.load(std::memory_order_relaxed);
    for (const Kernels* one : all_kernels)
        if (!now && runs(one)) now = one;
    chosen.store(now, std::memory_order_relaxed);
    return *now;
}

}  // namespace ash

extern "C" {

// Changes whenever a function below or its arguments change; ash/native/library.py holds the same number.
int ash_abi_version() { return 7; }

// The address of GOMP_parallel in the OpenMP runtime whose threads all calls shall use; null: threads of their own.
void ash_use_team(void* parallel) {
    // The runtime's threads do not survive a fork, and it would wait for them: a child starts its own.
    static const int once = pthread_atfork(nullptr, nullptr, [] { ash::parallel_of_torch.store(nullptr); });
    (void)once;
    ash::parallel_of_torch.store(reinterpret_cast<ash::Parallel>(parallel));
}

const char* ash_instruction_set() { return ash::kernels().name; }

// 0 if the machine runs it, else nothing changes.
int ash_use_instruction_set(const char* name) {
    for (const ash::Kernels* one : ash::all_kernels)
        if (!std::strcmp(one->name, name) && ash::runs(one)) {
            ash::chosen.store(one);
            return 0;
        }
    return 1;
}

// Floating point operations per second of nothing but fused multiply-adds, on `threads` threads: the best of many short runs.
double ash_fma_peak(int threads) {
    constexpr int64_t ROUNDS = 40000;
    constexpr int RUNS = 200;
    std::vector<double> best(threads, 0.0);
    ash::in_parallel(threads, threads, [&](int64_t thread) {
        for (int run = 0; run < RUNS; ++run) {
            auto start = std::chrono::steady_clock::now();
            double work = ash::kernels().fma_work(ROUNDS);
            std::chrono::duration<double> time = std::chrono::steady_clock::now() - start;
            best[thread] = std::max(best[thread], work / time.count());
        }
    });
    return std::accumulate(best.begin(), best.end(), 0.0);
}
}
