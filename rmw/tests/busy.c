// SPDX-License-Identifier: MIT OR Apache-2.0
// A node on rcl alone, whose callbacks are busy for a time. Each `--` begins a thread that waits for the topics after it:
//   busy NODE -- TOPIC MICROSECONDS [TOPIC MICROSECONDS ...] [-- ...]
// It says `runs` once all threads have waited, and at the end of its input what they did, with times of CLOCK_MONOTONIC in ns:
//   thread THREAD IS_FIFO PRIORITY FAULTS    FAULTS: page faults of its jobs, but of those whose NUMBER is FIRST
//   job THREAD CALLBACK NUMBER PRIORITY WAITS READY BEGINS ENDS    WAITS and READY: before and after the wait that reported it
//   gap THREAD FROM TO                                    the thread did not run, and did not sleep

#define _GNU_SOURCE
#include <pthread.h>
#include <sched.h>
#include <stdatomic.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/resource.h>
#include <time.h>

#include <rcl/error_handling.h>
#include <rcl/rcl.h>
#include <std_msgs/msg/u_int64.h>

// Threads, and topics of each.
#define MOST 8
#define ROOM 20000
// The number of a topic's first message, with which its thread warms up.
#define FIRST UINT64_MAX
// A thread that only reads the clock reads it more often.
#define GAP_NS 3000
#define PATIENCE_NS (20 * 1000 * 1000)

struct callback {
  const char * topic;
  int64_t busy_ns;
  rcl_subscription_t subscription;
};

struct job {
  size_t callback;
  uint64_t number;
  int priority;
  int64_t waits_ns, ready_ns, begins_ns, ends_ns;
};

struct gap {
  int64_t from_ns, to_ns;
};

struct thread {
  pthread_t id;
  struct callback callbacks[MOST];
  size_t callback_count, job_count, gap_count;
  int is_fifo, priority;
  long faults;
  struct job * jobs;
  struct gap * gaps;
};

static rcl_context_t context;
static struct thread threads[MOST];
static atomic_int waiting;
static atomic_bool is_over;

static void check(rcl_ret_t code, const char * what)
{
  if (code != RCL_RET_OK) {
    fprintf(stderr, "%s: %s\n", what, rcl_get_error_string().str);
    exit(1);
  }
}

static int64_t clock_ns(clockid_t clock)
{
  struct timespec now;
  clock_gettime(clock, &now);
  return now.tv_sec * INT64_C(1000000000) + now.tv_nsec;
}

static int64_t now_ns(void)
{
  return clock_ns(CLOCK_MONOTONIC);
}

static int own_priority(void)
{
  struct sched_param parameters;
  sched_getparam(0, &parameters);
  return parameters.sched_priority;
}

static void note_gap(struct thread * thread, int64_t from_ns, int64_t to_ns)
{
  if (to_ns - from_ns >= GAP_NS && thread->gap_count < ROOM) {
    thread->gaps[thread->gap_count++] = (struct gap) {from_ns, to_ns};
  }
}

struct mark {
  int64_t now_ns, used_ns;
  long sleeps, faults;
};

static struct mark mark(void)
{
  struct rusage usage;
  getrusage(RUSAGE_THREAD, &usage);
  long faults = usage.ru_minflt + usage.ru_majflt;
  return (struct mark) {now_ns(), clock_ns(CLOCK_THREAD_CPUTIME_ID), usage.ru_nvcsw, faults};
}

// What the thread did not use of the time since then, unless it slept. Returns when that was.
static struct mark note_since(struct thread * thread, struct mark then)
{
  struct mark now = mark();
  if (now.sleeps == then.sleeps) {
    note_gap(thread, then.now_ns + now.used_ns - then.used_ns, now.now_ns);
  }
  return now;
}

// Works for so long, whatever takes the core away meanwhile.
static void work(struct thread * thread, int64_t busy_ns)
{
  int64_t last_ns = now_ns(), done_ns = 0;
  while (done_ns < busy_ns) {
    int64_t next_ns = now_ns();
    if (next_ns - last_ns < GAP_NS) {
      done_ns += next_ns - last_ns;
    }
    note_gap(thread, last_ns, next_ns);
    last_ns = next_ns;
  }
}

static void * run(void * of)
{
  struct thread * thread = of;
  size_t count = thread->callback_count;
  rcl_wait_set_t set = rcl_get_zero_initialized_wait_set();
  check(rcl_wait_set_init(&set, count, 0, 0, 0, 0, 0, &context, rcl_get_default_allocator()), "wait set");
  int64_t patience_ns = 0;
  struct mark since = mark();
  while (!is_over) {
    check(rcl_wait_set_clear(&set), "clear");
    for (size_t i = 0; i < count; i++) {
      check(rcl_wait_set_add_subscription(&set, &thread->callbacks[i].subscription, NULL), "add");
    }
    since = note_since(thread, since);
    int64_t waits_ns = since.now_ns;
    rcl_ret_t waited = rcl_wait(&set, patience_ns);
    since = note_since(thread, since);
    int64_t ready_ns = since.now_ns;
    if (patience_ns == 0) {
      thread->is_fifo = (sched_getscheduler(0) & ~SCHED_RESET_ON_FORK) == SCHED_FIFO;
      thread->priority = own_priority();
      patience_ns = PATIENCE_NS;
      waiting++;
    }
    if (waited == RCL_RET_TIMEOUT) {
      continue;
    }
    check(waited, "wait");
    for (size_t i = 0; i < count; i++) {
      std_msgs__msg__UInt64 message;
      if (set.subscriptions[i] == NULL || thread->job_count == ROOM) {
        continue;
      }
      check(rcl_take(set.subscriptions[i], &message, NULL, NULL), "take");
      note_since(thread, since);
      struct job job = {i, message.data, own_priority(), waits_ns, ready_ns, now_ns(), 0};
      work(thread, thread->callbacks[i].busy_ns);
      struct mark end = mark();
      thread->faults += job.number == FIRST ? 0 : end.faults - since.faults;
      since = end;
      job.ends_ns = since.now_ns;
      thread->jobs[thread->job_count++] = job;
    }
  }
  check(rcl_wait_set_fini(&set), "end of the wait set");
  return NULL;
}

// Memory that is there.
static void * room(size_t bytes)
{
  void * memory = malloc(bytes);
  return memory == NULL ? NULL : memset(memory, 1, bytes);
}

int main(int count, char ** arguments)
{
  rcl_init_options_t options = rcl_get_zero_initialized_init_options();
  rcl_node_options_t node_options = rcl_node_get_default_options();
  rcl_node_t node = rcl_get_zero_initialized_node();
  context = rcl_get_zero_initialized_context();
  check(rcl_init_options_init(&options, rcl_get_default_allocator()), "options");
  check(rcl_init(0, NULL, &options, &context), "context");
  check(rcl_node_init(&node, arguments[1], "", &context, &node_options), "node");

  const rosidl_message_type_support_t * type = ROSIDL_GET_MSG_TYPE_SUPPORT(std_msgs, msg, UInt64);
  rcl_subscription_options_t subscription_options = rcl_subscription_get_default_options();
  struct thread * thread = threads - 1;
  for (int i = 2; i < count; i++) {
    if (strcmp(arguments[i], "--") == 0) {
      (++thread)->jobs = room(ROOM * sizeof(struct job));
      thread->gaps = room(ROOM * sizeof(struct gap));
    } else {
      struct callback * callback = &thread->callbacks[thread->callback_count++];
      callback->topic = arguments[i];
      callback->busy_ns = atoll(arguments[++i]) * 1000;
      callback->subscription = rcl_get_zero_initialized_subscription();
      check(
        rcl_subscription_init(&callback->subscription, &node, type, callback->topic, &subscription_options),
        callback->topic);
    }
  }
  int thread_count = (int)(thread + 1 - threads);
  for (int i = 0; i < thread_count; i++) {
    pthread_create(&threads[i].id, NULL, run, &threads[i]);
  }
  while (waiting < thread_count) {
    sched_yield();
  }
  puts("runs");
  fflush(stdout);
  while (getchar() != EOF) {
  }
  is_over = true;
  for (int i = 0; i < thread_count; i++) {
    thread = &threads[i];
    pthread_join(thread->id, NULL);
    printf("thread %d %d %d %ld\n", i, thread->is_fifo, thread->priority, thread->faults);
    for (size_t n = 0; n < thread->job_count; n++) {
      struct job * job = &thread->jobs[n];
      printf(
        "job %d %zu %lu %d %ld %ld %ld %ld\n", i, job->callback, job->number, job->priority, job->waits_ns,
        job->ready_ns, job->begins_ns, job->ends_ns);
    }
    for (size_t n = 0; n < thread->gap_count; n++) {
      printf("gap %d %ld %ld\n", i, thread->gaps[n].from_ns, thread->gaps[n].to_ns);
    }
    for (size_t n = 0; n < thread->callback_count; n++) {
      check(rcl_subscription_fini(&thread->callbacks[n].subscription, &node), "end of a subscription");
    }
  }
  check(rcl_node_fini(&node), "end of the node");
  check(rcl_shutdown(&context), "shutdown");
  check(rcl_context_fini(&context), "end of the context");
  return 0;
}
