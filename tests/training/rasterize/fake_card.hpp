// Runs CUDA kernels on the CPU, for tests. The threads of a block are coroutines of one thread. A warp's or a block's
// threads wait for each other as on a GPU, so missing or divergent synchronisation ends in an error instead of a result.

#include <csetjmp>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <deque>
#include <tuple>
#include <utility>
#include <ucontext.h>
#include <vector>

#define __global__
#define __device__
#define __shared__ static

struct Index { int x; };
static Index blockIdx, blockDim, threadIdx;

struct Barrier { std::vector<int> waiting; };
struct Thread { jmp_buf state; ucontext_t start; std::vector<char> stack; bool started; };

static std::vector<Thread> threads;
static std::deque<int> ready;
static Barrier block_barrier, warp_barriers[32];
static int current, running;
static ucontext_t scheduler;
static void (*body)(void**);
static void** arguments;
static double slots[1024];

static void resume(int next) {
    current = threadIdx.x = next;
    if (threads[next].started) { _longjmp(threads[next].state, 1); }
    threads[next].started = true;
    setcontext(&threads[next].start);
}

static void next_thread() {
    if (ready.empty()) {
        if (running) { std::fprintf(stderr, "kernel: threads wait for others that ended\n"); std::abort(); }
        setcontext(&scheduler);
    }
    int next = ready.front();
    ready.pop_front();
    resume(next);
}

static void run_thread() {
    body(arguments);
    running--;
    next_thread();
}

static void wait(Barrier& barrier, int members) {
    if ((int)barrier.waiting.size() + 1 == members) {
        for (int other : barrier.waiting) { ready.push_back(other); }
        barrier.waiting.clear();
        return;
    }
    barrier.waiting.push_back(current);
    if (!_setjmp(threads[current].state)) { next_thread(); }
}

static void wait_for_block() { wait(block_barrier, blockDim.x); }
static void wait_for_warp() { wait(warp_barriers[current / 32], 32); }

static void run_blocks(void (*kernel)(void**), int blocks, int count, void** pointers) {
    if ((int)threads.size() < count) { threads.resize(count); }
    body = kernel;
    arguments = pointers;
    blockDim.x = count;
    for (blockIdx.x = 0; blockIdx.x < blocks; blockIdx.x++) {
        running = count;
        for (int k = 0; k < count; k++) {
            Thread& thread = threads[k];
            thread.stack.resize(1 << 15);
            thread.started = false;
            getcontext(&thread.start);
            thread.start.uc_stack.ss_sp = thread.stack.data();
            thread.start.uc_stack.ss_size = thread.stack.size();
            makecontext(&thread.start, run_thread, 0);
            if (k) { ready.push_back(k); }
        }
        volatile bool ended = false;
        getcontext(&scheduler);
        if (!ended) {
            ended = true;
            resume(0);
        }
    }
}

static inline void __syncthreads() { wait_for_block(); }

template <typename F> static auto exchange(double value, int first, int count, void (*wait_for)(), F result) {
    slots[current] = value;
    wait_for();
    auto answer = result(slots + first, count);
    wait_for();
    return answer;
}

static inline int __syncthreads_and(int value) {
    return exchange(value != 0, 0, blockDim.x, wait_for_block, [](double* all, int count) {
        int sum = 1;
        for (int k = 0; k < count; k++) { sum &= all[k] != 0; }
        return sum;
    });
}

static inline unsigned int __ballot_sync(unsigned int, int value) {
    return exchange(value != 0, current / 32 * 32, 32, wait_for_warp, [](double* all, int count) {
        unsigned int bits = 0;
        for (int k = 0; k < count; k++) { bits |= (unsigned int)(all[k] != 0) << k; }
        return bits;
    });
}

static inline int __all_sync(unsigned int mask, int value) { return __ballot_sync(mask, value) == mask; }
static inline int __any_sync(unsigned int mask, int value) { return __ballot_sync(mask, value) != 0; }

static inline float __shfl_xor_sync(unsigned int, float value, int distance) {
    int other = current % 32 ^ distance;
    return exchange(value, current / 32 * 32, 32, wait_for_warp, [other](double* all, int) { return (float)all[other]; });
}

template <typename T> static inline T atomicAdd(T* at, T value) { T old = *at; *at += value; return old; }
static inline int atomicMax(int* at, int value) { int old = *at; *at = value > old ? value : old; return old; }
static inline int __ffs(int bits) { return __builtin_ffs(bits); }
static inline int __popc(unsigned int bits) { return __builtin_popcount(bits); }
static inline int __float_as_int(float value) { int bits; std::memcpy(&bits, &value, 4); return bits; }
static inline float __int_as_float(int bits) { float value; std::memcpy(&value, &bits, 4); return value; }

// Call a kernel with arguments at pointers, as cuLaunchKernel does.
template <typename... A, std::size_t... K>
static void call(void (*kernel)(A...), void** pointers, std::index_sequence<K...>) {
    kernel(*static_cast<A*>(pointers[K])...);
}

template <typename... A> static int arity(void (*)(A...)) { return sizeof...(A); }

template <auto Kernel> struct Caller;
template <typename... A, void (*Kernel)(A...)> struct Caller<Kernel> {
    static void run(void** pointers) { call(Kernel, pointers, std::index_sequence_for<A...>()); }
};

#define LAUNCHER(name) \
    extern "C" int arity_##name() { return arity(name); } \
    extern "C" void launch_##name(int blocks, int count, void** pointers) { \
        run_blocks(Caller<name>::run, blocks, count, pointers); \
    }
