// The instruction set: the best that this machine runs, unless another is asked for by name.
#include "dispatch.h"

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstring>
#include <numeric>
#include <vector>

#include <pthread.h>

#if defined(ASH_TILES) && defined(__linux__)
#include <cpuid.h>
#include <sys/syscall.h>
#include <unistd.h>
#endif

#include "team.h"
#include "tiles.h"

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

#if defined(ASH_TILES) && defined(__linux__)
// Tiles are state that Linux hands out to those who ask.
static bool grants_tiles() {
    constexpr unsigned BF16_VECTORS = 1u << 5, BF16_TILES = 1u << 22, TILES = 1u << 24;
    constexpr long REQUEST = 0x1023, TILE_DATA = 18;
    unsigned a, b, c, d;
    if (!runs(&avx512_kernels) || !__get_cpuid_count(7, 0, &a, &b, &c, &d) || (~d & (BF16_TILES | TILES))) return false;
    if (!__get_cpuid_count(7, 1, &a, &b, &c, &d) || !(a & BF16_VECTORS)) return false;
    return syscall(SYS_arch_prctl, REQUEST, TILE_DATA) == 0;
}
const TileKernels* tiles() {
    static const TileKernels* const granted = grants_tiles() ? &amx_kernels : nullptr;
    return granted;
}
#else
const TileKernels* tiles() { return nullptr; }
#endif

}  // namespace ash

extern "C" {

// Changes whenever a function below or its arguments change; ash/native/library.py holds the same number.
int ash_abi_version() { return 8; }

// The address of GOMP_parallel in the OpenMP runtime whose threads all calls shall use; null: threads of their own.
void ash_use_team(void* parallel) {
    // The runtime's threads do not survive a fork, and it would wait for them: a child starts its own.
    static const int once = pthread_atfork(nullptr, nullptr, [] { ash::parallel_of_torch.store(nullptr); });
    (void)once;
    ash::parallel_of_torch.store(reinterpret_cast<ash::Parallel>(parallel));
}

// Whether convolutions can be done in bfloat16, see tiles.h.
int ash_has_tiles() { return ash::tiles() != nullptr; }

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
