/* libpsao: ambient occlusion that a server traces, as points that your shaders blend.
 * Generated from sdk/ffi by psao-gen: do not edit.
 *
 * A client follows one stream. It does no input or output, has no thread and no clock, and takes
 * no memory but the block that you give it:
 *
 *     psao_config config = {.struct_size = sizeof config};
 *     config.cell_count = ...;                         what it may hold: you say it, or
 *     psao_config_from_stream(bytes, n, &config);      a stream's first bytes
 *     psao_client_memory_size(&config, &size, &align); one block, yours to take and to free
 *     psao_client_init(&config, memory, size, &client);
 *
 *     for each piece of the stream, until it is used up:
 *         psao_client_push(client, bytes, n, now_ns, &used);
 *
 *     for each picture:
 *         if (psao_client_take(client, &frame) == PSAO_OK) {
 *             psao_client_dirty_ranges(...);           upload these parts of frame's buffers
 *             psao_client_release(client);
 *         }
 *
 * Threads. Pushing is one side, taking the other; psao_client says which functions are whose. Each
 * side must be one thread at a time. With config.two_threads = 1 the sides may be two threads that
 * run at once, and never wait for each other: a frame that is complete while the other side reads
 * stays with the pusher and is merged into the next. Whatever the timing, a frame taken is whole,
 * and frames come in the order sent.
 *
 * Results. 0 and above is a success, below 0 a failure; on failure no output is written. Many
 * clients may live in one process. Nothing here is global, and nothing throws.
 */
#ifndef PSAO_H
#define PSAO_H

#include <stddef.h>
#include <stdint.h>

/* The library's version, of this header: 10000 major + 100 minor + patch. */
#define PSAO_VERSION 100

/* The version of the ABI. Functions say since which one they are there; none goes away or changes
 * within a major version of the library. */
#define PSAO_ABI_VERSION 1

/* The version of the stream format that this header was made for: 10000 major + minor. */
#define PSAO_STREAM_VERSION 10000

/* The longest message that psao_uplink_joints writes, with 4096 joints. */
#define PSAO_UPLINK_MAX_BYTES 196628

/* The longest message of any other psao_uplink_ function. */
#define PSAO_UPLINK_SMALL_BYTES 384

/* What a function answers: 0 or more is a success, less is a failure, and what the function
 * writes is then untouched. Values are never reused; new ones may come. */
typedef int32_t psao_result;
enum {
  /* Done. From psao_client_push: a frame was completed, take it before you push on. */
  PSAO_OK = 0,
  /* All input was used, and more is needed. Nothing to do but to go on. */
  PSAO_NEED_MORE = 1,
  /* Nothing came since the last take. Keep what you have. */
  PSAO_NOTHING_NEW = 2,
  /* The mirror differs from the server's. Send psao_uplink_resync, and push on: the last frame
   * stays in place until a snapshot comes. */
  PSAO_RESYNC = 3,
  /* A pointer is NULL that must not be. */
  PSAO_ERROR_NULL = -1,
  /* struct_size is not that of a struct this library knows, or the part it does not know is
   * not zero: use the library that the header came with, or a newer one. */
  PSAO_ERROR_STRUCT = -2,
  /* A value is out of its range: see the function. */
  PSAO_ERROR_VALUE = -3,
  /* Called at a time when it makes no sense: see the function. */
  PSAO_ERROR_ORDER = -4,
  /* The memory is smaller than psao_client_memory_size says. */
  PSAO_ERROR_MEMORY_SIZE = -5,
  /* The memory is not aligned as psao_client_memory_size says. */
  PSAO_ERROR_MEMORY_ALIGN = -6,
  /* An earlier push failed: connect anew and call psao_client_restart. */
  PSAO_ERROR_FAILED = -7,
  /* These bytes are not a PSAO stream: look at where they come from. */
  PSAO_ERROR_NOT_A_STREAM = -20,
  /* Another version or profile of the format: use matching versions of server and library. */
  PSAO_ERROR_VERSION = -21,
  /* Bytes were lost or changed on the way: connect anew. If it persists, the transport does not
   * deliver everything in order. */
  PSAO_ERROR_DAMAGED = -22,
  /* The bytes break the format: a faulty or hostile server. Connect anew. */
  PSAO_ERROR_FORMAT = -23,
  /* The server has another scene: load the same files on both sides. */
  PSAO_ERROR_SCENE = -24,
  /* The server refused for a reason that this library does not know: psao_client_error_text has
   * the server's words. */
  PSAO_ERROR_REFUSED = -30,
  /* The server wants another token: pass the one it was started with. */
  PSAO_ERROR_REFUSED_TOKEN = -31,
  /* The server has another scene: load the same files on both sides. */
  PSAO_ERROR_REFUSED_SCENE = -32,
  /* The server speaks another version: update the older side. */
  PSAO_ERROR_REFUSED_VERSION = -33,
  /* The scene needs more room than the hello offered: raise the counts in psao_config. */
  PSAO_ERROR_REFUSED_CAPACITY = -34,
  /* The server serves as many clients as it may: try again later. */
  PSAO_ERROR_REFUSED_FULL = -35,
  /* The server did not understand the first message: it must be psao_uplink_hello's. */
  PSAO_ERROR_REFUSED_MALFORMED = -36,
  /* The stream needs more than psao_config allows: psao_client_error_text says what, and
   * psao_config_from_stream fills a config that is enough. */
  PSAO_ERROR_CAPACITY = -40,
  /* The buffer for what the function writes is too small. */
  PSAO_ERROR_OUTPUT_SIZE = -41,
  /* No server answers at the address, or the system has no socket or thread to give:
   * psao_connection_open's text says which. */
  PSAO_ERROR_NO_CONNECTION = -50,
  /* Who answers has not the certificate that was asked for: take the fingerprint that the server
   * prints, or the roots that signed its certificate. */
  PSAO_ERROR_UNTRUSTED = -51,
  /* The connection is closed: open a new one, and call psao_client_restart. */
  PSAO_ERROR_CLOSED = -52,
  /* The network is slower than what is to be sent: send the newest state again later. */
  PSAO_ERROR_BUSY = -53,
  /* A defect of the library: it stopped before it could do harm. This client answers nothing
   * else from now on; make a new one, and please report it. */
  PSAO_ERROR_INTERNAL = -90,
};

/* How important a message is. */
typedef uint32_t psao_log_level;
enum {
  /* Something failed, and says what to do. */
  PSAO_LOG_ERROR = 1,
  /* Something is not as it should be, and goes on. */
  PSAO_LOG_WARNING = 2,
  /* What happens, now and then. */
  PSAO_LOG_INFO = 3,
};

/* Which of a frame's buffers. */
typedef uint32_t psao_buffer;
enum {
  /* psao_frame.instances */
  PSAO_BUFFER_INSTANCES = 0,
  /* psao_frame.buckets */
  PSAO_BUFFER_BUCKETS = 1,
  /* psao_frame.cells */
  PSAO_BUFFER_CELLS = 2,
};

/* Where a client is in its stream. */
typedef uint32_t psao_state;
enum {
  /* No frame has come yet. Draw without AO: everything is open. */
  PSAO_STATE_CONNECTING = 0,
  /* The last frame is the server's. */
  PSAO_STATE_LIVE = 1,
  /* The last frame is older than it should be. Go on drawing it: it freezes, and catches up
   * without a flash. */
  PSAO_STATE_STALE = 2,
  /* The server ended the stream. The last frame stays good. */
  PSAO_STATE_ENDED = 3,
  /* A push failed. The last frame stays in place; psao_client_restart and a new stream go on
   * from it. */
  PSAO_STATE_FAILED = 4,
};

/* Follows one stream, in memory of yours. Opaque.
 *
 * Two sides use it: the pusher (psao_client_push, psao_client_restart, psao_client_header,
 * psao_client_topology_hash, psao_client_stats, psao_client_error_text) and the taker
 * (psao_client_take, psao_client_dirty_ranges, psao_client_lookup, psao_client_lookup_over_baked,
 * psao_client_release). Each side must be one thread at a time. With psao_config.two_threads both
 * sides may run at once, and neither ever waits for the other; without, they must not.
 * psao_client_status is anyone's, at any time. */
typedef struct psao_client psao_client;

#if defined(PSAO_QUIC)
/* An open connection. Opaque. It takes memory from the heap and has one thread, which runs the
 * protocol until the connection is closed. */
typedef struct psao_connection psao_connection;
#endif

/* Takes a message: message_bytes of UTF-8, not terminated, valid during the call. level is a
 * psao_log_level. Called on the thread of the function that has something to say, and only from
 * psao_client_init and psao_client_restart. */
typedef void (*psao_log)(void *user_data, uint32_t level, const char *message, size_t message_bytes);

/* What a client may hold, and how it is used. Set struct_size and the counts; zero elsewhere is
 * the default. psao_config_from_stream fills one from a stream's first bytes. */
typedef struct psao_config {
  /* sizeof(psao_config). */
  uint32_t struct_size;
  /* 1: one thread pushes and another takes; the buffers are then held twice. 0: the same
   * thread does both, or you lock. */
  uint32_t two_threads;
  /* Hash of the scene you loaded; 0 accepts any. */
  uint64_t scene_hash;
  /* psao_client_status calls a client stale for which the link showed no sign of life for so
   * long. 0: never for that reason. */
  uint64_t stale_after_ns;
  /* Takes messages; may be NULL. */
  psao_log log;
  /* Passed to log. */
  void *log_user_data;
  /* Most instances. */
  uint32_t instance_count;
  /* Most buckets, of all instances. */
  uint32_t bucket_count;
  /* Most cells, of all instances, and one. */
  uint32_t cell_count;
  /* Most slices. This and the next three are 0 for streams of profile cells. */
  uint32_t slice_count;
  /* Most points of slices that are open at a time. */
  uint32_t point_count;
  /* Most patches: parts of meshes with their points. */
  uint32_t patch_count;
  /* Most bytes of all patches. */
  uint32_t topology_bytes;
  /* Largest packet. 0: the format's limit, 4 MiB. */
  uint32_t max_body_bytes;
  /* Largest decompressed packet. 0: the format's limit, 4 MiB. */
  uint32_t max_raw_bytes;
  /* For engines that have baked occlusion: how long the first frame takes to come up over it,
   * in psao_status.stream_share. 0: it is there at once. */
  uint64_t ease_ns;
} psao_config;

/* What the stream says of itself. */
typedef struct psao_header {
  /* sizeof(psao_header), set by you. */
  uint32_t struct_size;
  /* 0 cells, 1 residual. */
  uint32_t profile;
  /* Kernel for the lookup: 0 paper, 1 planar. */
  uint32_t kernel;
  /* Elements of the instance buffer. */
  uint32_t instance_count;
  /* Elements of the bucket buffer. */
  uint32_t bucket_count;
  /* Elements of the cell buffer. */
  uint32_t cell_count;
  /* Hash of the server's scene. */
  uint64_t scene_hash;
  /* Longest ray. */
  float ao_distance_m;
  /* Points per square metre and side. */
  float density;
  /* Server frames per second. */
  float rate_hz;
  /* Occlusion may be off by so many 1/255. */
  uint32_t threshold;
} psao_header;

/* How a client is. */
typedef struct psao_status {
  /* sizeof(psao_status), set by you. */
  uint32_t struct_size;
  /* A psao_state. */
  uint32_t state;
  /* The last time, by your clock, at which the frame was the server's: while not live, AO is
   * what it was then. 0: never. */
  uint64_t live_ns;
  /* How much of the stream to show over baked occlusion: 0 before the first frame was taken,
   * 1 psao_config.ease_ns after it came. For psao_client_lookup_over_baked and the shaders'
   * psao_over_baked. */
  float stream_share;
} psao_status;

/* Totals since init, and the newest frame. */
typedef struct psao_stats {
  /* sizeof(psao_stats), set by you. */
  uint32_t struct_size;
  /* Number of the newest complete frame. */
  uint32_t frame_id;
  /* Its scene time. */
  uint64_t server_time_ns;
  /* How much later it came than the fastest frame of this stream, by your clock: what waits on
   * the way. */
  uint64_t delay_ns;
  /* Hash of its mirror. The server says the upper half with each frame, of the bytes it means. */
  uint64_t mirror_hash;
  /* Bytes pushed and used. */
  uint64_t stream_bytes;
  /* Complete frames. */
  uint64_t frame_count;
  /* Snapshots among them. */
  uint64_t snapshot_count;
  /* Frames that were discarded because the mirror's hash was not the server's. */
  uint64_t discarded_count;
  /* Frames that went into a later one because the taker was busy or late. */
  uint64_t merged_count;
  /* Instances received. */
  uint64_t instance_count;
  /* Buckets received. */
  uint64_t bucket_count;
  /* Cells received. */
  uint64_t cell_count;
  /* Changes of slices received. */
  uint64_t slice_count;
  /* Patches received. */
  uint64_t patch_count;
} psao_stats;

/* An instance's grid and hash table, as the shaders read it. */
typedef struct psao_instance {
  /* The grid's corner, in local units. */
  float origin[3];
  /* Interpolation radius, in cells. */
  float radius;
  /* Local units to cells. */
  float cells_per_unit[3];
  /* First bucket of this instance. */
  uint32_t bucket_first;
  /* Cells along each axis. */
  uint32_t dims[3];
  /* Buckets of this instance; 0: it has no points, ignore the rest. */
  uint32_t bucket_count;
  /* Takes a local normal to cell space, before normalising. */
  float normal_scale[3];
  /* Level of detail, 0 (all points) to 3. For people: the lookup does not need it. */
  uint32_t level;
} psao_instance;

/* Up to eight cells by their index; 0 ends the list. */
typedef struct psao_bucket {
  /* Cell indices. */
  uint32_t entries[8];
} psao_bucket;

/* A grid cell's points. */
typedef struct psao_cell {
  /* The cell's index in its instance's grid. */
  uint32_t key;
  /* Points of 32 bits: 1 allocated, 15 position, 8 normal, 8 occlusion from the top; 0 ends
   * the list. */
  uint32_t points[7];
} psao_cell;

/* A complete frame, yours until psao_client_release. The buffers stay where they are for the
 * client's life; their lengths change only where a new stream says so, and then all of them is
 * dirty. */
typedef struct psao_frame {
  /* sizeof(psao_frame), set by you. */
  uint32_t struct_size;
  /* Number, for psao_uplink_ack. */
  uint32_t frame_id;
  /* Scene time of this state. */
  uint64_t server_time_ns;
  /* Kernel for the lookup: 0 paper, 1 planar. */
  uint32_t kernel;
  /* Elements of instances. */
  uint32_t instance_count;
  /* Elements of buckets. */
  uint32_t bucket_count;
  /* Elements of cells. */
  uint32_t cell_count;
  /* 64 bytes each, aligned to 64. */
  const struct psao_instance *instances;
  /* 32 bytes each, aligned to 64. */
  const struct psao_bucket *buckets;
  /* 32 bytes each, aligned to 64. */
  const struct psao_cell *cells;
} psao_frame;

/* Elements that lie together. */
typedef struct psao_range {
  /* First element. */
  uint32_t first_index;
  /* Elements. */
  uint32_t count;
} psao_range;

#if defined(PSAO_QUIC)
/* Where to connect, and as whom. Strings are UTF-8 and end with a zero byte. */
typedef struct psao_connect {
  /* sizeof(psao_connect). */
  uint32_t struct_size;
  /* "host:port"; an IPv6 address in brackets. */
  const char *address;
  /* The name in the server's certificate; NULL: the host of address. */
  const char *server_name;
  /* The token that the server was started with; NULL: none. */
  const char *token;
  /* The server has exactly the certificate with this SHA-256, 64 hexadecimal digits: what it
   * prints when it starts. NULL: roots_pem says who is trusted. */
  const char *fingerprint;
  /* Certificates in PEM, one of which signed the server's. NULL if there is a fingerprint. */
  const char *roots_pem;
  /* Of psao_client_topology_hash; 0 for a new client. */
  uint64_t topology_hash;
} psao_connect;
#endif

/* Counts a connection's messages: one for what goes up the stream, another one for datagrams.
 * All zero at the start of every connection. Yours: no client knows of it. */
typedef struct psao_uplink {
  /* Number of the next message. */
  uint32_t next_sequence;
} psao_uplink;

/* Where you look from. The server sends what you see first. */
typedef struct psao_camera {
  /* sizeof(psao_camera). */
  uint32_t struct_size;
  /* Vertical field of view, above 0 and below pi. */
  float fov_y_rad;
  /* Width over height, above 0.001 and below 1000. */
  float aspect;
  /* Rows of the picture: decides how fine what is far away needs to be. 0: all as fine as near. */
  uint32_t height_px;
  /* World position. */
  double position_m[3];
  /* View direction, not zero. */
  float forward[3];
  /* Up, not zero and not along forward. */
  float up[3];
} psao_camera;

#ifdef __cplusplus
extern "C" {
#endif // __cplusplus

/* The library's version, which should be PSAO_VERSION: else the header is not the library's.
 *
 * Threads: any. No alloc, lock or log. Since ABI 1. */
uint32_t psao_version(void);

/* The ABI's version of the library: at least PSAO_ABI_VERSION, or functions are missing.
 *
 * Threads: any. No alloc, lock or log. Since ABI 1. */
uint32_t psao_abi_version(void);

/* Fills a config with just what a stream needs, from its first bytes: of a recording, or of what
 * a server sends. Zeroes the rest of it but struct_size.
 *
 * Check the memory that it asks for against your own limit: a hostile server may ask for a lot.
 *
 * Returns PSAO_NEED_MORE, and writes nothing, until the bytes hold the first packet (the first
 * 4116 bytes always do).
 *
 * Threads: any. No alloc, lock or log. Safe on untrusted input. Since ABI 1. */
psao_result psao_config_from_stream(const uint8_t *input,
                                    size_t input_bytes,
                                    struct psao_config *out_config);

/* Says how much memory a client with this config needs, and how it must be aligned. All that a
 * client ever uses is in there.
 *
 * PSAO_ERROR_VALUE: two_threads is neither 0 nor 1, max_body_bytes is below 64 or a limit above
 * the format's, or no machine has so much memory.
 *
 * Threads: any. No alloc, lock or log. Since ABI 1. */
psao_result psao_client_memory_size(const struct psao_config *config,
                                    size_t *out_bytes,
                                    size_t *out_align_bytes);

/* Makes a client in your memory, which is its own until you stop using it. There is nothing to
 * free but that. What was in the memory does not matter.
 *
 * Errors as psao_client_memory_size, and PSAO_ERROR_MEMORY_SIZE, PSAO_ERROR_MEMORY_ALIGN.
 *
 * Threads: any. No alloc or lock; may log. Since ABI 1. */
psao_result psao_client_init(const struct psao_config *config,
                             void *memory,
                             size_t memory_bytes,
                             struct psao_client **out_client);

/* Feeds stream bytes, in any portions: from a socket, a file, wherever.
 *
 * Stops behind every completed frame with PSAO_OK: take it, then push the rest. Everything else
 * that is no failure has used up all of the input: PSAO_NEED_MORE, and PSAO_RESYNC after which
 * you should send psao_uplink_resync.
 *
 * input may be NULL only if input_bytes is 0. Push 0 bytes when your transport shows that the
 * link lives though nothing came (a still scene sends nothing), and now and then with two
 * threads: it hands over what the taker was too busy for.
 *
 * now_ns: a clock of yours that does not run backwards; only differences count. 0 if you have
 * none.
 *
 * out_consumed_bytes: written on success only.
 *
 * PSAO_ERROR_ORDER: with one thread, while a frame is taken. Everything else below 0 ends the
 * stream: the last frame stays in place, psao_client_error_text has a sentence for a log, and
 * psao_client_restart makes ready for a new stream.
 *
 * Threads: pusher. Time: what the input asks for, bounded by its size and the config. No alloc,
 * lock or log. Safe on untrusted input. Since ABI 1. */
psao_result psao_client_push(struct psao_client *client,
                             const uint8_t *input,
                             size_t input_bytes,
                             uint64_t now_ns,
                             size_t *out_consumed_bytes);

/* Makes ready for a new stream, from its first byte, after a lost connection or a failure. The
 * last frame stays in place until the new stream's first snapshot: AO freezes, and does not
 * flash.
 *
 * Threads: pusher. No alloc or lock; may log. Since ABI 1. */
psao_result psao_client_restart(struct psao_client *client);

/* Reads what the stream says of itself.
 *
 * PSAO_ERROR_ORDER: before its header has come.
 *
 * Threads: pusher. No alloc, lock or log. Since ABI 1. */
psao_result psao_client_header(const struct psao_client *client, struct psao_header *out_header);

/* Says how the client is: whether its frame is the server's, and if not, since when.
 *
 * now_ns: the clock of psao_client_push.
 *
 * Threads: any, at any time. No alloc, lock or log. Since ABI 1. */
psao_result psao_client_status(const struct psao_client *client,
                               uint64_t now_ns,
                               struct psao_status *out_status);

/* Reads the hash of the patches that the client has got, for psao_uplink_hello of a new
 * connection: the server then need not send them again. 0 if some are missing. Read it before
 * psao_client_restart, and keep the client.
 *
 * A recording of patches alone (psao record --topology), shipped with the app and pushed first,
 * gives the same.
 *
 * Threads: pusher. No alloc, lock or log. Since ABI 1. */
psao_result psao_client_topology_hash(const struct psao_client *client, uint64_t *out_hash);

/* Reads the totals.
 *
 * Threads: pusher. No alloc, lock or log. Since ABI 1. */
psao_result psao_client_stats(const struct psao_client *client, struct psao_stats *out_stats);

/* Reads what failed last, as a sentence that names it and what to do: UTF-8, terminated, at most
 * 513 bytes with the end. Empty if nothing failed. A longer text than the buffer has room for is
 * cut off.
 *
 * out_bytes: the text's length without the end, written on success; may be NULL.
 *
 * PSAO_ERROR_OUTPUT_SIZE: capacity_bytes is 0.
 *
 * Threads: pusher. No alloc, lock or log. Since ABI 1. */
psao_result psao_client_error_text(const struct psao_client *client,
                                   char *out_text,
                                   size_t capacity_bytes,
                                   size_t *out_bytes);

/* Takes the newest complete frame. It is yours, and nothing changes it, until
 * psao_client_release. With two threads, what comes meanwhile waits in the pusher's copy and
 * comes with a later frame, all of it and in order.
 *
 * PSAO_NOTHING_NEW: none came since the last one that you took, or the pusher is just handing
 * one over: go on with what you have. There is nothing to release then.
 *
 * PSAO_ERROR_ORDER: you still have one.
 *
 * Threads: taker. Time: constant. No alloc, lock or log. Since ABI 1. */
psao_result psao_client_take(struct psao_client *client, struct psao_frame *out_frame);

/* Lists what of a buffer changed since the last release: what to upload. The first frame's
 * ranges cover the whole buffers, so yours need no clearing.
 *
 * join_count: ranges with at most so many unchanged elements between them come as one. An upload
 * has a price of its own; 16 suits most.
 *
 * ranges: capacity_count of them, filled in rising order. If there are more than fit, the last
 * one covers all the rest. So a fixed array is always enough, and bounds the number of uploads.
 *
 * PSAO_ERROR_VALUE: buffer is no psao_buffer, or capacity_count is 0. PSAO_ERROR_ORDER: no frame
 * is taken.
 *
 * Threads: taker. Time: grows with what changed. No alloc, lock or log. Since ABI 1. */
psao_result psao_client_dirty_ranges(const struct psao_client *client,
                                     uint32_t buffer,
                                     uint32_t join_count,
                                     struct psao_range *ranges,
                                     uint32_t capacity_count,
                                     uint32_t *out_count);

/* Copies buckets with a tag in each entry, which psao_planar_fast of the shaders wants: above the
 * cell's index (22 bits), a few bits of the cell's key, so that no cell is read in vain. Copy the
 * dirty ranges of PSAO_BUFFER_BUCKETS so, and upload the copies; a bucket is dirty, too, where
 * just a tag changed. psao_planar and psao_paper work with tags and without.
 *
 * out_buckets: count of them.
 *
 * PSAO_ERROR_VALUE: the range is not within the frame's buckets. PSAO_ERROR_CAPACITY: the frame
 * has more than 4194304 cells, so that their indices leave no room: upload the buckets as they
 * are, and call psao_planar. PSAO_ERROR_ORDER: no frame is taken.
 *
 * Threads: taker. Time: grows with count. No alloc, lock or log. Since ABI 1. */
psao_result psao_client_tag_buckets(const struct psao_client *client,
                                    uint32_t first_index,
                                    uint32_t count,
                                    struct psao_bucket *out_buckets);

/* Looks ambient occlusion up at points of one instance, on the CPU: what the shader does for
 * each fragment.
 *
 * positions, normals: count of them, of three floats each, in the instance's local space (its
 * rest space if it is skinned). Normals may have any length.
 *
 * out_openness: count values, 0 fully occluded to 1 open, never NaN. Unknown instances, positions
 * outside and numbers that are none answer 1.
 *
 * PSAO_ERROR_ORDER: no frame is taken.
 *
 * Threads: taker. Time: grows with count. No alloc, lock or log. Safe on untrusted input. Since
 * ABI 1. */
psao_result psao_client_lookup(const struct psao_client *client,
                               uint32_t instance_index,
                               const float *positions,
                               const float *normals,
                               size_t count,
                               float *out_openness);

/* As psao_client_lookup, over occlusion that was baked (psao bake --to vertex or texture): where
 * the stream covers a place it answers, elsewhere the baked value does. That is where its points
 * have not come yet, and where it left them out because all is open.
 *
 * baked: count values, 0 to 1. share: how much of the stream to show where it has come, 0 to 1,
 * of psao_status.stream_share. With 0 no frame need be taken, and the baked values are the
 * answers.
 *
 * out_openness: count values, 0 to 1, never NaN. May be baked.
 *
 * PSAO_ERROR_VALUE: share is not 0 to 1. PSAO_ERROR_ORDER: no frame is taken, and share is not 0.
 *
 * Threads: taker. Time: grows with count. No alloc, lock or log. Safe on untrusted input. Since
 * ABI 1. */
psao_result psao_client_lookup_over_baked(const struct psao_client *client,
                                          uint32_t instance_index,
                                          const float *positions,
                                          const float *normals,
                                          const float *baked,
                                          float share,
                                          size_t count,
                                          float *out_openness);

/* Gives the frame back. Everything that was dirty in it counts as uploaded.
 *
 * PSAO_ERROR_ORDER: no frame is taken.
 *
 * Threads: taker. Time: grows with what changed. No alloc, lock or log. Since ABI 1. */
psao_result psao_client_release(struct psao_client *client);

/* Makes everything dirty: call it when your buffers were lost with their device, or made anew.
 * The next psao_client_take then gives the newest frame, even if you had it before, and its
 * ranges cover the whole buffers.
 *
 * PSAO_ERROR_ORDER: a frame is taken; release it first.
 *
 * Threads: taker. Time: constant; the next psao_client_take's grows with the capacity. No alloc,
 * lock or log. Since ABI 1. */
psao_result psao_client_mark_all_dirty(struct psao_client *client);

#if defined(PSAO_QUIC)
/* Connects to a server and sends the hello: what psao_uplink_hello would write, with config and
 * connect's token. Waits until the server has proved who it is, or 5 s if nothing answers: not
 * for the frame loop.
 *
 * out_text, text_bytes: room for a sentence about why it failed, for a log; may be NULL and 0.
 * Unlike other outputs it is written on failure only, and ends with a zero byte.
 *
 * PSAO_ERROR_VALUE: a string is not UTF-8 or not what it should be, or there is not exactly one
 * of fingerprint and roots_pem. PSAO_ERROR_UNTRUSTED, PSAO_ERROR_NO_CONNECTION.
 *
 * Threads: any. Takes memory, and starts a thread. Safe on untrusted input. Since ABI 1, in
 * libraries built with the feature quic. */
psao_result psao_connection_open(const struct psao_connect *connect,
                                 const struct psao_config *config,
                                 char *out_text,
                                 size_t text_bytes,
                                 struct psao_connection **out_connection);
#endif

#if defined(PSAO_QUIC)
/* Takes bytes of the stream that have come, at most capacity_bytes, for psao_client_push. Never
 * waits. What is not taken stays, up to 1 MiB; beyond that the server is asked to wait, and
 * merges what changes meanwhile.
 *
 * out_bytes: how many.
 *
 * PSAO_NOTHING_NEW: none have come since. PSAO_ERROR_CLOSED: none will come any more, and all
 * that came was taken: out_text, if not NULL, has a sentence about why, as in
 * psao_connection_open.
 *
 * Threads: exclusive per connection. Takes memory now and then, and a lock that the connection's
 * thread holds for short. Since ABI 1, in libraries built with the feature quic. */
psao_result psao_connection_receive(struct psao_connection *connection,
                                    uint8_t *out,
                                    size_t capacity_bytes,
                                    size_t *out_bytes,
                                    char *out_text,
                                    size_t text_bytes);
#endif

#if defined(PSAO_QUIC)
/* Sends a message that a psao_uplink_ function wrote, but for the hello, which was sent. Its
 * number does not matter: the connection counts anew. Cameras and acknowledgements overtake
 * older ones; all else arrives surely and in order. Never waits.
 *
 * PSAO_ERROR_VALUE: it is no such message. PSAO_ERROR_BUSY: the network is slower than the
 * messages: send the newest state again later. PSAO_ERROR_CLOSED: see psao_connection_receive.
 *
 * Threads: exclusive per connection. Takes memory now and then, and a lock that the connection's
 * thread holds for short. Since ABI 1, in libraries built with the feature quic. */
psao_result psao_connection_send(struct psao_connection *connection,
                                 const uint8_t *message,
                                 size_t message_bytes);
#endif

#if defined(PSAO_QUIC)
/* Closes the connection, tells the server, ends its thread and frees its memory. Waits at most
 * 1 s.
 *
 * connection: not to be used afterwards. NULL does nothing.
 *
 * Threads: exclusive per connection. Since ABI 1, in libraries built with the feature quic. */
psao_result psao_connection_close(struct psao_connection *connection);
#endif

/* The name of a result, and what to do about it, in one line for a log. Never NULL.
 *
 * result: any value; an unknown one says so.
 *
 * Threads: any. No alloc, lock or log. Since ABI 1. */
const char *psao_result_str(int32_t result);

/* Writes the first message of every connection: who you are, and how much you can hold. Sets
 * uplink to begin.
 *
 * config: the client's; the server refuses a scene that needs larger counts. token, token_bytes:
 * at most 256 bytes, the one that the server was started with. topology_hash: of
 * psao_client_topology_hash; 0 for a new client.
 *
 * out: capacity_bytes; PSAO_UPLINK_SMALL_BYTES are enough. out_bytes: how long the message is.
 *
 * PSAO_ERROR_VALUE: the token is too long. PSAO_ERROR_OUTPUT_SIZE: out is too small; what is in
 * it is then undefined.
 *
 * Threads: exclusive per psao_uplink. No alloc, lock or log. Since ABI 1. */
psao_result psao_uplink_hello(struct psao_uplink *uplink,
                              const struct psao_config *config,
                              const uint8_t *token,
                              size_t token_bytes,
                              uint64_t topology_hash,
                              uint8_t *out,
                              size_t capacity_bytes,
                              size_t *out_bytes);

/* Writes where you look from. Send it when it changes, at most once a frame; as a datagram if
 * the transport has them, with a psao_uplink of its own.
 *
 * PSAO_ERROR_VALUE: a value is outside the range that psao_camera says, or not finite.
 *
 * out, capacity_bytes, out_bytes, Threads and the rest as psao_uplink_hello. Since ABI 1. */
psao_result psao_uplink_camera(struct psao_uplink *uplink,
                               const struct psao_camera *camera,
                               uint8_t *out,
                               size_t capacity_bytes,
                               size_t *out_bytes);

/* Writes that you moved an instance: from then on this places it, and not the scene's animation.
 *
 * world_from_local: 12 doubles, three rows of four, metres, the translation in the fourth column.
 *
 * PSAO_ERROR_VALUE: a value is not finite.
 *
 * out, capacity_bytes, out_bytes, Threads and the rest as psao_uplink_hello. Since ABI 1. */
psao_result psao_uplink_transform(struct psao_uplink *uplink,
                                  uint32_t instance_index,
                                  const double *world_from_local,
                                  uint8_t *out,
                                  size_t capacity_bytes,
                                  size_t *out_bytes);

/* Writes how you posed a skinned instance.
 *
 * local_from_rest: 12 floats a joint, three rows of four: what takes a vertex from rest space to
 * local space. joint_count: the skin's, at most 4096.
 *
 * out: 20 bytes and 48 a joint, at most PSAO_UPLINK_MAX_BYTES.
 *
 * PSAO_ERROR_VALUE: a value is not finite, or there are too many joints.
 *
 * out, capacity_bytes, out_bytes, Threads and the rest as psao_uplink_hello. Since ABI 1. */
psao_result psao_uplink_joints(struct psao_uplink *uplink,
                               uint32_t instance_index,
                               const float *local_from_rest,
                               uint32_t joint_count,
                               uint8_t *out,
                               size_t capacity_bytes,
                               size_t *out_bytes);

/* Writes that you took an instance out of the scene, or put it back: what is out has no points
 * and occludes nothing. All are in at first. To swap an instance's mesh, have an instance for
 * each mesh, and put one of them in.
 *
 * present: 1 if it is in the scene, 0 if it is not.
 *
 * PSAO_ERROR_VALUE: present is neither.
 *
 * out, capacity_bytes, out_bytes, Threads and the rest as psao_uplink_hello. Since ABI 1. */
psao_result psao_uplink_presence(struct psao_uplink *uplink,
                                 uint32_t instance_index,
                                 uint32_t present,
                                 uint8_t *out,
                                 size_t capacity_bytes,
                                 size_t *out_bytes);

/* Writes that a frame is in your mirror. Optional; a later one makes up for one that is lost.
 *
 * frame_id: of psao_frame or psao_stats.
 *
 * out, capacity_bytes, out_bytes, Threads and the rest as psao_uplink_hello. Since ABI 1. */
psao_result psao_uplink_ack(struct psao_uplink *uplink,
                            uint32_t frame_id,
                            uint8_t *out,
                            size_t capacity_bytes,
                            size_t *out_bytes);

/* Writes that you need a snapshot, after PSAO_RESYNC.
 *
 * out, capacity_bytes, out_bytes, Threads and the rest as psao_uplink_hello. Since ABI 1. */
psao_result psao_uplink_resync(struct psao_uplink *uplink,
                               uint8_t *out,
                               size_t capacity_bytes,
                               size_t *out_bytes);

#ifdef __cplusplus
}  // extern "C"
#endif  // __cplusplus

#endif  /* PSAO_H */
