// Shares out numbered pieces of work over the thread pool of XLA.
#pragma once

#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <memory>
#include <mutex>

#include "xla/ffi/api/ffi.h"

namespace jaxcloseup {

// Calls work(scratch, i) once for every i in [0, count), in any order and on any thread, and returns
// when all calls have. Each thread has a `Scratch` of its own for all its pieces. The calling thread
// takes pieces too, so it never waits for a thread that the pool may not have.
template <typename Scratch, typename Work>
void parallel_for_with(xla::ffi::ThreadPool& pool, int count, const Work& work) {
  struct Shared {
    const Work* work;
    int count;
    std::atomic<int> next{0}, done{0};
    std::mutex mutex;
    std::condition_variable all_done;

    void take() {
      int i = next.fetch_add(1);
      if (i >= count) return;
      Scratch scratch;
      for (; i < count; i = next.fetch_add(1)) {
        (*work)(scratch, i);
        if (done.fetch_add(1) + 1 == count) {
          std::lock_guard<std::mutex> lock(mutex);
          all_done.notify_all();
        }
      }
    }
  };
  // Tasks that start late find nothing left to do; they own what they look at.
  auto shared = std::make_shared<Shared>();
  shared->work = &work;
  shared->count = count;
  const int helpers = std::min<int>(static_cast<int>(pool.num_threads()), count) - 1;
  for (int i = 0; i < helpers; i++) pool.Schedule([shared] { shared->take(); });
  shared->take();
  std::unique_lock<std::mutex> lock(shared->mutex);
  shared->all_done.wait(lock, [&] { return shared->done.load() == count; });
}

// Calls work(i) likewise.
template <typename Work>
void parallel_for(xla::ffi::ThreadPool& pool, int count, const Work& work) {
  struct None {};
  parallel_for_with<None>(pool, count, [&](None&, int i) { work(i); });
}

}  // namespace jaxcloseup
