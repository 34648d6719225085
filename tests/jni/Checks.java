package org.psao;

import android.app.Activity;
import android.app.Application;
import android.content.res.AssetManager;
import android.net.ConnectivityManager;
import android.net.Network;
import java.io.ByteArrayInputStream;
import java.io.File;
import java.io.FileNotFoundException;
import java.io.IOException;
import java.lang.reflect.Field;
import java.nio.ByteBuffer;
import java.nio.ReadOnlyBufferException;
import java.nio.file.Files;
import java.util.ArrayList;
import java.util.Arrays;
import java.util.List;
import java.util.Scanner;
import java.util.concurrent.CountDownLatch;
import java.util.concurrent.atomic.AtomicBoolean;
import java.util.concurrent.atomic.AtomicInteger;
import java.util.concurrent.atomic.AtomicReference;
import org.psao.android.PsaoAssets;
import org.psao.android.PsaoLifecycle;
import org.psao.android.PsaoNetwork;

/** The promises of the Java API. Words: the check, the folder of conformance streams, more. */
public final class Checks {
    private final File folder;
    private final String[] words;

    private Checks(String[] words) {
        this.words = words;
        folder = new File(words[1]);
    }

    /** Runs one check. */
    public static void main(String[] words) throws Exception {
        Checks.class.getDeclaredMethod(words[0]).invoke(new Checks(words));
        System.out.println(words[0] + ": passed");
    }

    // What checks share.

    private static void check(boolean truth, String what) {
        if (!truth) {
            throw new AssertionError(what);
        }
    }

    private static void equal(Object expected, Object got) {
        check(expected.equals(got), "expected " + expected + ", got " + got);
    }

    private interface Act {
        void run() throws Exception;
    }

    /** What an act throws, which must be of this type. */
    private static <T extends Throwable> T thrown(Class<T> type, Act act) {
        try {
            act.run();
        } catch (Throwable error) {
            check(type.isInstance(error), "expected " + type + ", got " + error);
            return type.cast(error);
        }
        throw new AssertionError("expected " + type + ", got nothing");
    }

    private static void fails(int result, Act act) {
        PsaoException error = thrown(PsaoException.class, act);
        equal(result, error.result());
        String name = Native.resultText(result).split(":")[0];
        check(error.getMessage().startsWith(name + ":"), error.getMessage());
    }

    private byte[] bytes(String name) throws IOException {
        return Files.readAllBytes(new File(folder, name + ".psao").toPath());
    }

    private PsaoBuffer stream(String name) throws IOException {
        byte[] bytes = bytes(name);
        PsaoBuffer buffer = new PsaoBuffer(bytes.length);
        buffer.bytes().put(bytes).flip();
        return buffer;
    }

    private static PsaoConfig small() {
        PsaoConfig config = new PsaoConfig();
        config.instanceCount = config.bucketCount = config.cellCount = 16;
        config.maxBodyBytes = config.maxRawBytes = 4096;
        return config;
    }

    /** FNV-1a of a frame's buffers, eight bytes at a time. */
    private static long mix(long digest, PsaoFrame frame) {
        for (int buffer = PsaoFrame.INSTANCES; buffer <= PsaoFrame.CELLS; buffer++) {
            ByteBuffer bytes = frame.buffer(buffer);
            while (bytes.hasRemaining()) {
                digest = (digest ^ bytes.getLong()) * 1099511628211L;
            }
        }
        return digest;
    }

    private static final long NO_DIGEST = 0xcbf29ce484222325L;

    // The checks.

    private static final class Outcome {
        int frames;
        long resyncs;
        long digest = NO_DIGEST;
        int result;
    }

    private int lookups(PsaoClient client, File expected) throws IOException {
        int count = 0;
        PsaoBuffer position = new PsaoBuffer(12);
        PsaoBuffer normal = new PsaoBuffer(12);
        PsaoBuffer openness = new PsaoBuffer(4);
        for (String line : Files.readAllLines(expected.toPath())) {
            String[] numbers = line.trim().split("\\s+");
            equal(8, numbers.length);
            for (int i = 0; i < 3; i++) {
                position.bytes().putFloat(4 * i, Float.parseFloat(numbers[1 + i]));
                normal.bytes().putFloat(4 * i, Float.parseFloat(numbers[4 + i]));
            }
            client.lookup(Integer.parseInt(numbers[0]), position, normal, 1, openness);
            float off = openness.bytes().getFloat(0) - Float.parseFloat(numbers[7]);
            check(Math.abs(off) <= 1 / 255f, line);
            count++;
        }
        return count;
    }

    private Outcome play(PsaoBuffer stream, int piece, PsaoBuffer before, int frames, File lookups)
            throws IOException {
        Outcome out = new Outcome();
        PsaoConfig config;
        stream.bytes().clear();
        try {
            config = PsaoConfig.fromStream(stream);
        } catch (PsaoException error) {
            // It must fail for a client with any memory, and with the same result.
            config = new PsaoConfig();
            config.instanceCount = config.bucketCount = config.cellCount = 16;
        }
        if (config == null) {
            config = small();
            config.maxBodyBytes = config.maxRawBytes = 0;
        }
        try (PsaoClient client = new PsaoClient(config)) {
            if (before != null) {
                before.bytes().clear();
                try {
                    while (before.bytes().hasRemaining()) {
                        client.push(before, 0);
                    }
                } catch (PsaoException failed) {
                    // Whatever came of it.
                }
                client.restart();
            }
            int length = stream.bytes().capacity();
            try {
                while (stream.bytes().position() < length) {
                    int end = stream.bytes().position() + Math.min(piece, length);
                    stream.bytes().limit(Math.min(end, length));
                    out.result = client.push(stream, 0);
                    if (out.result != PsaoResult.OK) {
                        continue;
                    }
                    PsaoFrame frame = client.take();
                    out.digest = mix(out.digest, frame);
                    out.frames++;
                    if (lookups != null && out.frames == frames) {
                        check(lookups(client, lookups) > 0, "lookups");
                    }
                    client.release();
                }
            } catch (PsaoException failed) {
                out.result = failed.result();
            }
            PsaoStats stats = new PsaoStats();
            client.stats(stats);
            out.resyncs = stats.discardedCount();
        }
        return out;
    }

    void conformance() throws IOException {
        int streams = 0;
        for (String line : Files.readAllLines(new File(folder, "index.txt").toPath())) {
            String[] parts = line.split(" ");
            boolean valid = parts[0].equals("valid");
            PsaoBuffer stream = stream(parts[2]);
            PsaoBuffer before = valid && parts.length > 6 ? stream(parts[6]) : null;
            for (int piece : new int[] {stream.bytes().capacity(), 977, 1}) {
                if (!valid) {
                    Outcome out = play(stream, piece, null, 0, null);
                    check(out.result == Integer.parseInt(parts[3]), line + ": " + out.result);
                    continue;
                }
                int frames = Integer.parseInt(parts[3]);
                File lookups = frames == 0 ? null : new File(folder, parts[2] + ".lookups");
                Outcome out = play(stream, piece, before, frames, lookups);
                check(out.result >= 0 && out.frames == frames
                        && out.resyncs == Long.parseLong(parts[4])
                        && out.digest == Long.parseUnsignedLong(parts[5], 16), line);
            }
            streams++;
        }
        System.out.println(streams + " streams");
    }

    void results() throws IllegalAccessException {
        int results = 0;
        for (Field field : PsaoResult.class.getFields()) {
            String text = Native.resultText(field.getInt(null));
            equal("PSAO_" + field.getName(), text.split(":")[0]);
            results++;
        }
        check(Native.resultText(77).contains("unknown"), Native.resultText(77));
        System.out.println(results + " results");
    }

    void wrongUse() throws IOException {
        // Buffers.
        thrown(IllegalArgumentException.class, () -> new PsaoBuffer(-1));
        thrown(IllegalArgumentException.class, () -> new PsaoBuffer(ByteBuffer.allocate(4)));
        ByteBuffer readOnly = ByteBuffer.allocateDirect(4).asReadOnlyBuffer();
        thrown(IllegalArgumentException.class, () -> new PsaoBuffer(readOnly));
        thrown(NullPointerException.class, () -> new PsaoBuffer(null));

        // Configs.
        equal(0, new PsaoBuffer(0).bytes().capacity());
        check(PsaoConfig.fromStream(new PsaoBuffer(0)) == null, "a config of nothing");
        PsaoBuffer nonsense = new PsaoBuffer(100);
        fails(PsaoResult.ERROR_NOT_A_STREAM, () -> PsaoConfig.fromStream(nonsense));
        PsaoConfig config = small();
        config.cellCount = -1;
        fails(PsaoResult.ERROR_VALUE, config::memoryBytes);
        fails(PsaoResult.ERROR_VALUE, () -> new PsaoClient(config));
        config.cellCount = 1L << 32;
        fails(PsaoResult.ERROR_VALUE, () -> new PsaoClient(config));
        config.cellCount = (1L << 32) - 1;
        check(config.memoryBytes() > 1L << 36, "memory for 2^32 cells");
        fails(PsaoResult.ERROR_VALUE, () -> new PsaoClient(config));
        config.cellCount = 1 << 25;
        thrown(OutOfMemoryError.class, () -> new PsaoClient(config));
        thrown(NullPointerException.class, () -> new PsaoClient(null));

        // Order.
        PsaoBuffer stream = stream("residual");
        PsaoClient client = new PsaoClient(PsaoConfig.fromStream(stream));
        fails(PsaoResult.ERROR_ORDER, () -> client.header(new PsaoHeader()));
        fails(PsaoResult.ERROR_ORDER, client::release);
        check(client.take() == null, "a frame of nothing");
        while (client.push(stream, 0) != PsaoResult.OK) {
            continue;
        }
        PsaoFrame frame = client.take();
        fails(PsaoResult.ERROR_ORDER, client::take);
        fails(PsaoResult.ERROR_ORDER, () -> client.push(stream, 0));
        thrown(NullPointerException.class, () -> client.push(null, 0));
        thrown(NullPointerException.class, () -> client.stats(null));

        // Frames.
        for (int buffer : new int[] {-1, 3}) {
            thrown(IllegalArgumentException.class, () -> frame.buffer(buffer));
            thrown(IllegalArgumentException.class, () -> frame.count(buffer));
            thrown(IllegalArgumentException.class, () -> frame.dirtyRanges(buffer, 0));
        }
        thrown(IllegalArgumentException.class, () -> frame.dirtyRanges(0, -1));
        equal(1, frame.dirtyRanges(PsaoFrame.CELLS, 0));
        equal(frame.count(PsaoFrame.CELLS), frame.rangeCount(0));
        equal(32 * frame.rangeCount(0), frame.range(0).remaining());
        thrown(IndexOutOfBoundsException.class, () -> frame.range(1));
        thrown(IndexOutOfBoundsException.class, () -> frame.rangeFirst(-1));
        thrown(ReadOnlyBufferException.class, () -> frame.buffer(0).put(0, (byte) 1));

        // Buckets with tags.
        int buckets = frame.count(PsaoFrame.BUCKETS);
        PsaoBuffer tagged = new PsaoBuffer(32 * buckets);
        frame.tagBuckets(0, buckets, tagged);
        int tags = 0;
        for (int at = 0; at < 32 * buckets; at += 4) {
            int entry = tagged.bytes().getInt(at);
            equal(frame.buffer(PsaoFrame.BUCKETS).getInt(at), entry & 0x3fffff);
            tags += entry >>> 22 == 0 ? 0 : 1;
        }
        check(tags > 100, tags + " tags");
        fails(PsaoResult.ERROR_VALUE, () -> frame.tagBuckets(1, buckets, tagged));
        thrown(IllegalArgumentException.class, () -> frame.tagBuckets(-1, 1, tagged));
        thrown(IllegalArgumentException.class, () -> frame.tagBuckets(0, -1, tagged));
        thrown(IllegalArgumentException.class, () -> frame.tagBuckets(0, buckets + 1, tagged));
        thrown(NullPointerException.class, () -> frame.tagBuckets(0, 1, null));

        // Lookups.
        PsaoBuffer points = new PsaoBuffer(24);
        PsaoBuffer two = new PsaoBuffer(8);
        client.lookup(1 << 30, points, points, 2, two);
        equal(1f, two.bytes().getFloat(4));
        thrown(IllegalArgumentException.class, () -> client.lookup(0, points, points, 3, two));
        thrown(IllegalArgumentException.class, () -> client.lookup(0, points, points, -1, two));
        thrown(IllegalArgumentException.class, () -> client.lookup(0, points, two, 2, two));
        thrown(IllegalArgumentException.class,
                () -> client.lookup(0, points, points, 2, new PsaoBuffer(7)));
        ByteBuffer odd = ByteBuffer.allocateDirect(64);
        odd.position(1);
        PsaoBuffer unaligned = new PsaoBuffer(odd.slice());
        thrown(IllegalArgumentException.class, () -> client.lookup(0, points, points, 1, points));
        PsaoBuffer within = new PsaoBuffer(points.bytes());
        thrown(IllegalArgumentException.class, () -> client.lookup(0, points, points, 1, within));
        fails(PsaoResult.ERROR_VALUE, () -> client.lookup(0, unaligned, points, 2, two));
        fails(PsaoResult.ERROR_ORDER, client::markAllDirty);
        client.release();
        fails(PsaoResult.ERROR_ORDER, () -> frame.dirtyRanges(0, 0));
        fails(PsaoResult.ERROR_ORDER, () -> frame.tagBuckets(0, 1, tagged));
        thrown(IndexOutOfBoundsException.class, () -> frame.range(0));

        // All of it again, into buffers that were made anew.
        check(client.take() == null, "a frame twice");
        client.markAllDirty();
        check(client.take() == frame, "no frame again");
        equal(1, frame.dirtyRanges(PsaoFrame.CELLS, 0));
        equal(frame.count(PsaoFrame.CELLS), frame.rangeCount(0));
        client.release();

        // Failed streams say why, until a restart.
        PsaoBuffer damaged = stream("packet-missing");
        PsaoClient other = new PsaoClient(PsaoConfig.fromStream(damaged));
        PsaoException error = thrown(PsaoException.class, () -> {
            while (damaged.bytes().hasRemaining()) {
                other.push(damaged, 0);
            }
        });
        equal(PsaoResult.ERROR_DAMAGED, error.result());
        check(error.getMessage().matches("PSAO_ERROR_DAMAGED: .+ \\(.+\\)"), error.getMessage());
        fails(PsaoResult.ERROR_FAILED, () -> other.push(damaged, 0));
        PsaoStatus status = new PsaoStatus();
        other.status(0, status);
        equal(PsaoStatus.FAILED, status.state());
        other.restart();
        other.close();

        // A closed client, again and again. What was taken can still be read.
        ByteBuffer cells = frame.buffer(PsaoFrame.CELLS);
        client.close();
        client.close();
        List<Act> all = Arrays.asList(
                () -> client.push(stream, 0), client::restart, client::take, client::release,
                client::topologyHash, client::nativeClient, client::markAllDirty,
                () -> frame.tagBuckets(0, 1, tagged),
                () -> client.header(new PsaoHeader()), () -> client.stats(new PsaoStats()),
                () -> client.status(0, status), () -> frame.dirtyRanges(0, 0),
                () -> client.lookup(0, points, points, 2, two));
        for (Act act : all) {
            String message = thrown(IllegalStateException.class, act).getMessage();
            check(message.contains("closed"), message);
        }
        System.gc();
        equal(frame.count(PsaoFrame.CELLS) * 32, cells.capacity());
        long sum = 0;
        while (cells.hasRemaining()) {
            sum += cells.getLong();
        }
        check(sum != 0, "cells of a closed client");

        // Messages.
        PsaoUplink uplink = new PsaoUplink();
        PsaoBuffer out = new PsaoBuffer(PsaoUplink.SMALL_BYTES);
        char[] tooLong = new char[257];
        Arrays.fill(tooLong, 'x');
        fails(PsaoResult.ERROR_VALUE, () -> uplink.hello(small(), new String(tooLong), 0, out));
        fails(PsaoResult.ERROR_VALUE, () -> uplink.hello(config(-1), "", 0, out));
        fails(PsaoResult.ERROR_VALUE,
                () -> uplink.camera(4, 1, 0, 0, 0, 0, 0, 0, 1, 0, 1, 0, out));
        thrown(IllegalArgumentException.class, () -> uplink.transform(0, new double[11], out));
        thrown(IllegalArgumentException.class, () -> uplink.joints(0, two, 1, out));
        thrown(IllegalArgumentException.class, () -> uplink.joints(0, two, -1, out));
        thrown(IllegalArgumentException.class, () -> uplink.joints(0, out, 1, out));
        equal(0, out.bytes().position());
        fails(PsaoResult.ERROR_OUTPUT_SIZE, () -> uplink.ack(1, new PsaoBuffer(8)));
    }

    private static PsaoConfig config(long cellCount) {
        PsaoConfig config = small();
        config.cellCount = cellCount;
        return config;
    }

    /** Digest of each frame, from a client that takes them one by one. */
    private long[] expected(String name) throws IOException {
        long[] digests = new long[4096];
        PsaoBuffer stream = stream(name);
        try (PsaoClient client = new PsaoClient(PsaoConfig.fromStream(stream))) {
            while (stream.bytes().hasRemaining()) {
                if (client.push(stream, 0) == PsaoResult.OK) {
                    PsaoFrame frame = client.take();
                    digests[frame.frameId()] = mix(NO_DIGEST, frame);
                    client.release();
                }
            }
        }
        return digests;
    }

    void threads() throws Exception {
        for (int round = 0; round < 20; round++) {
            for (String name : new String[] {"cells", "residual"}) {
                together(name);
            }
        }
        // Two threads on one side, or on both of a client that is for one: one of them is told.
        for (boolean twoThreads : new boolean[] {true, false}) {
            PsaoConfig config = small();
            config.twoThreads = twoThreads;
            PsaoClient client = new PsaoClient(config);
            PsaoBuffer nothing = new PsaoBuffer(0);
            AtomicInteger refused = new AtomicInteger();
            Act push = () -> client.push(nothing, 0);
            Act other = twoThreads ? () -> client.stats(new PsaoStats()) : () -> client.take();
            AtomicBoolean enough = new AtomicBoolean();
            Thread[] both = new Thread[2];
            for (int i = 0; i < 2; i++) {
                Act act = i == 0 ? push : other;
                both[i] = new Thread(() -> {
                    while (!enough.get()) {
                        try {
                            act.run();
                        } catch (IllegalStateException error) {
                            check(error.getMessage().startsWith("two threads"), "" + error);
                            enough.set(refused.incrementAndGet() > 0);
                        } catch (Exception error) {
                            throw new AssertionError(error);
                        }
                    }
                });
                both[i].start();
            }
            for (Thread thread : both) {
                thread.join();
            }
            check(refused.get() > 0, "nobody was refused");
            client.push(nothing, 0);
            client.close();
        }
    }

    private void together(String name) throws Exception {
        long[] expected = expected(name);
        PsaoBuffer stream = stream(name);
        PsaoConfig config = PsaoConfig.fromStream(stream);
        config.twoThreads = true;
        PsaoClient client = new PsaoClient(config);
        AtomicReference<Throwable> failure = new AtomicReference<>();
        AtomicBoolean done = new AtomicBoolean();
        Thread pusher = new Thread(() -> {
            int length = stream.bytes().capacity();
            int piece = 1;
            while (stream.bytes().position() < length) {
                piece = piece * 5 % 4093 + 1;
                int end = Math.min(length, stream.bytes().position() + piece);
                stream.bytes().limit(end);
                client.push(stream, end);
            }
            done.set(true);
        });
        pusher.setUncaughtExceptionHandler((thread, error) -> failure.set(error));
        pusher.start();
        PsaoStatus status = new PsaoStatus();
        int last = 0;
        int taken = 0;
        for (boolean ended = false; !ended;) {
            ended = done.get() || failure.get() != null;
            if (ended) {
                pusher.join();
                stream.bytes().limit(stream.bytes().position());
                equal(PsaoResult.NEED_MORE, client.push(stream, 0));
            }
            client.status(0, status);
            check(status.state() != PsaoStatus.FAILED, "failed");
            PsaoFrame frame = client.take();
            if (frame == null) {
                continue;
            }
            check(frame.frameId() > last, "frames out of order");
            last = frame.frameId();
            equal(expected[last], mix(NO_DIGEST, frame));
            taken++;
            client.release();
        }
        check(failure.get() == null, "" + failure.get());
        check(taken > 0 && expected[last] != 0 && expected[last + 1] == 0, "the last frame");
        client.close();
    }

    void closeMeanwhile() throws Exception {
        for (int round = 0; round < 50; round++) {
            PsaoBuffer stream = stream("residual");
            PsaoConfig config = PsaoConfig.fromStream(stream);
            config.twoThreads = true;
            PsaoClient client = new PsaoClient(config, (level, message) -> { });
            CountDownLatch started = new CountDownLatch(2);
            AtomicReference<Throwable> failure = new AtomicReference<>();
            Act push = () -> {
                stream.bytes().clear();
                client.restart();
                started.countDown();
                while (stream.bytes().hasRemaining()) {
                    client.push(stream, 0);
                }
            };
            Act take = () -> {
                PsaoFrame frame = client.take();
                started.countDown();
                if (frame != null) {
                    mix(NO_DIGEST, frame);
                    client.release();
                }
            };
            List<Thread> threads = new ArrayList<>();
            for (Act act : Arrays.asList(push, take)) {
                Thread thread = new Thread(() -> {
                    String message = thrown(IllegalStateException.class, () -> {
                        while (true) {
                            act.run();
                        }
                    }).getMessage();
                    check(message.contains("closed"), message);
                });
                thread.setUncaughtExceptionHandler((which, error) -> failure.set(error));
                threads.add(thread);
                thread.start();
            }
            started.await();
            // Somewhere in a push, another place each round.
            for (int spin = 0; spin < round; spin++) {
                Thread.yield();
            }
            client.close();
            for (Thread thread : threads) {
                thread.join();
            }
            check(failure.get() == null, "" + failure.get());
        }
    }

    private static long residentBytes() throws IOException {
        try (Scanner pages = new Scanner(new File("/proc/self/statm"))) {
            pages.nextLong();
            return 4096 * pages.nextLong();
        }
    }

    void tenThousand() throws IOException {
        PsaoBuffer nothing = new PsaoBuffer(0);
        PsaoConfig config = small();
        long bytes = config.memoryBytes();
        // A leak of it would show, and one of a fiftieth of it.
        check(bytes > 100000, "a client of " + bytes);
        long before = 0;
        for (int i = 0; i < 12000; i++) {
            // Every third is forgotten instead: the collector finds it.
            PsaoClient client = new PsaoClient(config, i % 2 == 0 ? (level, text) -> { } : null);
            client.push(nothing, 0);
            if (i % 3 > 0) {
                client.close();
            }
            if (i == 2000) {
                System.gc();
                before = residentBytes();
            }
        }
        System.gc();
        long grown = residentBytes() - before;
        System.out.println("10000 clients of " + bytes + " bytes: " + grown + " bytes more");
        check(grown < 16 << 20, "grown by " + grown);
    }

    void panics() throws IOException {
        PsaoBuffer nothing = new PsaoBuffer(0);
        PsaoClient client = new PsaoClient(small());
        PsaoClient other = new PsaoClient(small());
        fails(PsaoResult.ERROR_INTERNAL,
                () -> PsaoException.check(Provoke.panicOfClient(client.nativeClient(), client)));
        // It answers nothing else from now on; all others do.
        fails(PsaoResult.ERROR_INTERNAL, () -> client.push(nothing, 0));
        fails(PsaoResult.ERROR_INTERNAL, client::take);
        fails(PsaoResult.ERROR_INTERNAL, client::restart);
        equal(PsaoResult.NEED_MORE, other.push(nothing, 0));
        RuntimeException error = thrown(RuntimeException.class, Provoke::panicOnTheWay);
        check(("" + error).contains("provoked"), "" + error);
        equal(PsaoResult.NEED_MORE, other.push(nothing, 0));
        client.close();
        other.close();
    }

    void logs() throws Exception {
        List<String> said = new ArrayList<>();
        List<Thread> threads = new ArrayList<>();
        PsaoLog log = (level, message) -> {
            said.add(level + " " + message);
            threads.add(Thread.currentThread());
        };
        PsaoClient client = new PsaoClient(small(), log);
        equal(1, said.size());
        check(said.get(0).matches("3 psao: a client in \\d+ bytes"), said.get(0));
        PsaoBuffer nonsense = new PsaoBuffer(100);
        fails(PsaoResult.ERROR_NOT_A_STREAM, () -> client.push(nonsense, 0));
        client.restart();
        equal(2, said.size());
        check(said.get(1).startsWith("1 "), said.get(1));
        check(threads.get(1) == Thread.currentThread(), "another thread");
        for (int i = 0; i < 100; i++) {
            fails(PsaoResult.ERROR_NOT_A_STREAM, () -> client.push(nonsense, 0));
            equal(PsaoResult.OK, Provoke.restartElsewhere(client.nativeClient(), client));
        }
        equal(102, said.size());
        check(threads.get(101) != Thread.currentThread(), "the same thread");
        // It was attached only until it ended.
        threads.get(101).join(60000);
        check(!threads.get(101).isAlive(), "still attached");
        client.close();

        PsaoClient hostile = new PsaoClient(small(), (level, message) -> {
            throw new IllegalArgumentException("of the listener");
        });
        fails(PsaoResult.ERROR_NOT_A_STREAM, () -> hostile.push(nonsense, 0));
        hostile.restart();
        fails(PsaoResult.ERROR_NOT_A_STREAM, () -> hostile.push(nonsense, 0));
        equal(PsaoResult.OK, Provoke.restartElsewhere(hostile.nativeClient(), hostile));
        hostile.close();
    }

    /** One pass over a stream, as an engine with one thread does it. */
    private static int frames(
            PsaoClient client, PsaoBuffer stream, PsaoStats stats, PsaoStatus status,
            PsaoHeader header, PsaoUplink uplink, PsaoBuffer points, PsaoBuffer out,
            double[] matrix) {
        int uploads = 0;
        stream.bytes().clear();
        client.restart();
        while (stream.bytes().hasRemaining()) {
            int result = client.push(stream, 1);
            client.status(1, status);
            if (result != PsaoResult.OK) {
                continue;
            }
            client.header(header);
            PsaoFrame frame = client.take();
            for (int buffer = PsaoFrame.INSTANCES; buffer <= PsaoFrame.CELLS; buffer++) {
                int count = frame.dirtyRanges(buffer, 16);
                for (int i = 0; i < count; i++) {
                    uploads += frame.range(i).remaining() > 0 ? 1 : 0;
                }
            }
            client.lookup(0, points, points, 1, out);
            client.release();
            client.stats(stats);
            client.topologyHash();
            out.bytes().clear();
            uplink.camera(1, 1, 0, 0, 0, 0, 0, 0, 1, 0, 1, 0, out);
            out.bytes().clear();
            uplink.transform(0, matrix, out);
            out.bytes().clear();
            uplink.joints(0, points, 1, out);
            uplink.presence(0, true, out);
            uplink.ack(frame.frameId(), out);
            uplink.resync(out);
        }
        return uploads;
    }

    void garbage() throws IOException {
        com.sun.management.ThreadMXBean meter = (com.sun.management.ThreadMXBean)
                java.lang.management.ManagementFactory.getThreadMXBean();
        long self = Thread.currentThread().getId();
        PsaoBuffer stream = stream("residual");
        PsaoStats stats = new PsaoStats();
        PsaoStatus status = new PsaoStatus();
        PsaoHeader header = new PsaoHeader();
        PsaoUplink uplink = new PsaoUplink();
        PsaoBuffer points = new PsaoBuffer(48);
        PsaoBuffer out = new PsaoBuffer(1024);
        double[] matrix = new double[12];
        try (PsaoClient client = new PsaoClient(PsaoConfig.fromStream(stream))) {
            // The first pass makes the views, and loads classes.
            Runnable pass = () -> {
                int uploads = frames(
                        client, stream, stats, status, header, uplink, points, out, matrix);
                check(uploads > 20, "few uploads");
            };
            pass.run();
            meter.getThreadAllocatedBytes(self);
            long before = meter.getThreadAllocatedBytes(self);
            long nothing = meter.getThreadAllocatedBytes(self) - before;
            before = meter.getThreadAllocatedBytes(self);
            pass.run();
            long bytes = meter.getThreadAllocatedBytes(self) - before - nothing;
            System.out.println(bytes + " bytes of garbage in 10 frames");
            equal(0L, bytes);
            // The meter sees what there is.
            before = meter.getThreadAllocatedBytes(self);
            new PsaoStats();
            check(meter.getThreadAllocatedBytes(self) - before > 0, "the meter sees nothing");
        }
    }

    void uplink() {
        PsaoUplink uplink = new PsaoUplink();
        PsaoBuffer out = new PsaoBuffer(2 * PsaoUplink.MAX_BYTES);
        PsaoConfig config = small();
        config.sceneHash = 0x0123456789abcdefL;
        List<Integer> ends = new ArrayList<>();
        uplink.hello(config, "s\u00e9same", 77, out);
        ends.add(out.bytes().position());
        uplink.camera(1, 1.5f, 1080, 1, 2, 3, 0, 0, -1, 0, 1, 0, out);
        ends.add(out.bytes().position());
        uplink.transform(3, new double[] {1, 0, 0, 5, 0, 1, 0, 6, 0, 0, 1, 7}, out);
        ends.add(out.bytes().position());
        PsaoBuffer joints = new PsaoBuffer(4096 * 48);
        uplink.joints(4, joints, 4096, out);
        ends.add(out.bytes().position());
        equal(PsaoUplink.MAX_BYTES, ends.get(3) - ends.get(2));
        uplink.presence(5, false, out);
        uplink.ack(6, out);
        uplink.resync(out);
        // docs/format.md, 2.3: the sequence and the body's length.
        ByteBuffer bytes = out.bytes();
        int length = bytes.position();
        int at = 0;
        int sequence = 0;
        while (at < length) {
            equal(sequence, (int) bytes.getShort(at + 2));
            at += 12 + bytes.getInt(at + 4);
            sequence++;
        }
        equal(length, at);
        equal(7, sequence);
        // A hello begins to count anew.
        bytes.clear();
        uplink.hello(config, "", 0, out);
        equal(0, (int) bytes.getShort(2));
    }

    void player() throws Exception {
        long[] expected = expected("cells");
        PsaoBuffer stream = stream("cells");
        PsaoConfig config = PsaoConfig.fromStream(stream);
        config.twoThreads = true;
        try (PsaoClient client = new PsaoClient(config)) {
            PsaoPlayer player =
                    new PsaoPlayer(client, new ByteArrayInputStream(bytes("cells")));
            player.pause();
            player.pause();
            Thread thread = new Thread(player);
            thread.start();
            // The first frame comes, and then it stands.
            PsaoFrame frame = null;
            while (frame == null) {
                frame = client.take();
            }
            equal(1, frame.frameId());
            client.release();
            while (thread.getState() != Thread.State.WAITING) {
                Thread.yield();
            }
            check(client.take() == null, "it plays while it is paused");
            player.resume();
            thread.join();
            check(player.failure() == null, "" + player.failure());
            int last = 0;
            for (frame = client.take(); frame != null; frame = client.take()) {
                last = frame.frameId();
                equal(expected[last], mix(NO_DIGEST, frame));
                client.release();
            }
            check(last > 1 && expected[last + 1] == 0, "the last frame is " + last);
        }
        // What fails is said.
        PsaoClient other = new PsaoClient(config);
        PsaoPlayer wrong = new PsaoPlayer(other, new ByteArrayInputStream(new byte[100]));
        wrong.run();
        fails(PsaoResult.ERROR_NOT_A_STREAM, () -> {
            throw wrong.failure();
        });
        other.close();
        PsaoPlayer closed = new PsaoPlayer(other, new ByteArrayInputStream(bytes("cells")));
        closed.run();
        check(closed.failure() instanceof IllegalStateException, "" + closed.failure());
    }

    void android() throws Exception {
        AssetManager assets = new AssetManager(folder);
        PsaoConfig config = PsaoAssets.config(assets, "cells.psao");
        thrown(FileNotFoundException.class, () -> PsaoAssets.config(assets, "none.psao"));
        fails(PsaoResult.ERROR_NOT_A_STREAM, () -> PsaoAssets.config(assets, "index.txt"));
        config.twoThreads = true;
        PsaoClient client = new PsaoClient(config);
        PsaoPlayer player = PsaoAssets.player(client, assets, "cells.psao");
        Application application = new Application();
        Activity activity = new Activity(application);
        Activity other = new Activity(application);
        PsaoLifecycle.follow(activity, player);
        equal(1, application.listeners.size());
        Application.ActivityLifecycleCallbacks lifecycle = application.listeners.get(0);
        lifecycle.onActivityPaused(activity);
        Thread thread = new Thread(player);
        thread.start();
        lifecycle.onActivityResumed(other);
        while (thread.getState() != Thread.State.WAITING) {
            Thread.yield();
        }
        PsaoFrame frame = client.take();
        equal(1, frame.frameId());
        client.release();
        lifecycle.onActivityDestroyed(other);
        equal(1, application.listeners.size());
        lifecycle.onActivityDestroyed(activity);
        equal(0, application.listeners.size());
        thread.join();
        check(player.failure() == null && client.take() == null, "it went on");
        client.close();

        ConnectivityManager manager = activity.connectivity;
        AtomicInteger changes = new AtomicInteger();
        PsaoNetwork network = new PsaoNetwork(activity, changes::incrementAndGet);
        ConnectivityManager.NetworkCallback callback = manager.listeners.get(0);
        Network first = new Network();
        callback.onAvailable(first);
        callback.onAvailable(first);
        equal(0, changes.get());
        callback.onAvailable(new Network());
        equal(1, changes.get());
        network.close();
        equal(0, manager.listeners.size());
    }

    /** Median of several rounds, in nanoseconds a call. */
    private static void time(String name, Runnable calls, int count) {
        double[] rounds = new double[9];
        for (int round = -3; round < rounds.length; round++) {
            long start = System.nanoTime();
            calls.run();
            long end = System.nanoTime();
            if (round >= 0) {
                rounds[round] = (end - start) / (double) count;
            }
        }
        Arrays.sort(rounds);
        System.out.printf("%s: %.1f%n", name, rounds[rounds.length / 2]);
    }

    /** As tests/jni/calls.c. */
    void calls() throws IOException {
        int count = 200000;
        PsaoBuffer stream = stream("residual");
        PsaoClient client = new PsaoClient(PsaoConfig.fromStream(stream));
        while (stream.bytes().hasRemaining()) {
            client.push(stream, 0);
        }
        client.take();
        client.release();
        PsaoStatus status = new PsaoStatus();
        PsaoStats stats = new PsaoStats();
        PsaoUplink uplink = new PsaoUplink();
        PsaoBuffer out = new PsaoBuffer(PsaoUplink.SMALL_BYTES);
        time("push of nothing", () -> {
            for (int i = 0; i < count; i++) {
                check(client.push(stream, i) == PsaoResult.NEED_MORE, "push");
            }
        }, count);
        time("take of nothing new", () -> {
            for (int i = 0; i < count; i++) {
                check(client.take() == null, "take");
            }
        }, count);
        time("status", () -> {
            for (int i = 0; i < count; i++) {
                client.status(i, status);
            }
        }, count);
        time("stats", () -> {
            for (int i = 0; i < count; i++) {
                client.stats(stats);
            }
        }, count);
        time("camera", () -> {
            for (int i = 0; i < count; i++) {
                out.bytes().clear();
                uplink.camera(1, 1, 0, 0, 0, 0, 0, 0, 1, 0, 1, 0, out);
            }
        }, count);
        equal(10, stats.frameId());
        equal(PsaoStatus.ENDED, status.state());
        check(out.bytes().position() > 16, "camera");
    }

    void connects() throws Exception {
        PsaoBuffer stream = stream("cells");
        PsaoConfig config = PsaoConfig.fromStream(stream);
        String address = words[2];
        String fingerprint = words[3];
        String token = words[4];
        fails(PsaoResult.ERROR_NULL,
                () -> new PsaoConnection(null, null, token, fingerprint, null, 0, config));
        fails(PsaoResult.ERROR_VALUE,
                () -> new PsaoConnection(address, null, token, null, null, 0, config));
        PsaoException wrong = thrown(PsaoException.class,
                () -> new PsaoConnection(address, null, token, "12:34", null, 0, config));
        check(wrong.getMessage().contains("64 hexadecimal digits"), wrong.getMessage());
        String another = fingerprint.replaceAll("[0-9a-fA-F]", "7");
        fails(PsaoResult.ERROR_UNTRUSTED,
                () -> new PsaoConnection(address, null, token, another, null, 0, config));
        PsaoConnection connection =
                new PsaoConnection(address, null, token, fingerprint, null, 0, config);
        PsaoClient client = new PsaoClient(config);
        PsaoUplink uplink = new PsaoUplink();
        PsaoBuffer message = new PsaoBuffer(PsaoUplink.SMALL_BYTES);
        fails(PsaoResult.ERROR_VALUE, () -> connection.send(message));
        uplink.presence(3, false, message);
        message.bytes().flip();
        connection.send(message);
        PsaoBuffer came = new PsaoBuffer(777);
        PsaoStatus status = new PsaoStatus();
        int frames = 0;
        while (status.state() != PsaoStatus.ENDED) {
            came.bytes().clear();
            if (connection.receive(came) == 0) {
                Thread.sleep(1);
            }
            came.bytes().flip();
            while (came.bytes().hasRemaining()) {
                frames += client.push(came, 0) == PsaoResult.OK ? 1 : 0;
            }
            client.status(0, status);
        }
        message.bytes().clear();
        uplink.ack(frames, message);
        message.bytes().flip();
        connection.send(message);
        // The server closes when it has that.
        PsaoException closed = thrown(PsaoException.class, () -> {
            while (true) {
                came.bytes().clear();
                equal(0, connection.receive(came));
                Thread.sleep(1);
            }
        });
        equal(PsaoResult.ERROR_CLOSED, closed.result());
        check(closed.getMessage().matches("PSAO_ERROR_CLOSED: .+ \\(.+\\)"), closed.getMessage());
        connection.close();
        connection.close();
        thrown(IllegalStateException.class, () -> connection.receive(came));
        client.close();
    }
}
